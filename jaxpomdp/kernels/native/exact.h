// The exact route: a whole row in logarithms and double precision.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "tapes.h"

namespace {

constexpr double kNone = -1e30, kNoneBelow = -5e29;

double log_sum_exp(const double* x, Index count) {
  double best = *std::max_element(x, x + count), total = 0;
  if (best < kNoneBelow) return kNone;
  for (Index i = 0; i < count; ++i) total += std::exp(x[i] - best);
  return best + std::log(total);
}

// out_j = log sum_i exp(x_i) m[i * row + j * column]: a product, or term by term where that would underflow.
void log_product(const double* x, const float* m, Index N, Index row, Index column, double* out) {
  double best = *std::max_element(x, x + N);
  std::vector<double> weight(N), term(N);
  for (Index i = 0; i < N; ++i) weight[i] = best < kNoneBelow ? 0 : std::exp(x[i] - best);
  for (Index j = 0; j < N; ++j) {
    double total = 0;
    for (Index i = 0; i < N; ++i) total += weight[i] * m[i * row + j * column];
    if (total > 1e-280) {
      out[j] = best + std::log(total);
      continue;
    }
    for (Index i = 0; i < N; ++i) {
      double step = m[i * row + j * column];
      term[i] = step > 0 ? std::max(x[i] + std::log(step), kNone) : kNone;
    }
    out[j] = log_sum_exp(term.data(), N);
  }
}

// Log-beliefs [T, N] of a row; returns its log-normalisers [T], kNone where the observation is ignored.
std::vector<double> Worker::exact_forward(Index lane, std::vector<double>& log_belief) const {
  std::vector<double> norms(T_, 0.0), predicted(N_), joint(N_);
  const float* init = p_.init + model_ * N_;
  for (Index t = 0; t < T_; ++t) {
    const int32_t how = arrival(lane, t);
    if (how == kPadding) continue;
    if (how >= 0) log_product(&log_belief[(t - 1) * N_], trans(how), N_, N_, 1, predicted.data());
    else for (Index n = 0; n < N_; ++n) predicted[n] = init[n] > 0 ? std::log((double)init[n]) : kNone;
    for (Index n = 0; n < N_; ++n) joint[n] = std::max(predicted[n] + log_obs(lane, t)[n], kNone);
    norms[t] = log_sum_exp(joint.data(), N_);
    const bool heeded = norms[t] > kNoneBelow;
    if (!heeded) norms[t] = kNone;
    for (Index n = 0; n < N_; ++n)
      log_belief[t * N_ + n] = heeded ? std::max(joint[n] - norms[t], kNone) : predicted[n];
  }
  return norms;
}

void Worker::exact_counts(const double* belief, const double* weight, double norm, Index a, float* xi) const {
  const float* step = trans(a);
  const double best = *std::max_element(weight, weight + N_);
  for (Index i = 0; i < N_; ++i) {
    if (belief[i] + best - norm < -200) continue;  // adds nothing that a float could hold
    for (Index j = 0; j < N_; ++j)
      if (weight[j] > kNoneBelow && step[i * N_ + j] > 0)
        xi[(a * N_ + i) * N_ + j] += std::exp(belief[i] + weight[j] - norm) * step[i * N_ + j];
  }
}

// A whole row in logarithms; without xi only the filter's results are written.
void Worker::exact(Index lane, float* xi, float* initial) {
  const bool smoothing = xi != nullptr;
  std::vector<double> log_belief(T_ * N_, kNone), future(N_), weight(N_), joint(N_);
  const std::vector<double> norms = exact_forward(lane, log_belief);
  for (Index t = T_ - 1; t >= 0; --t) {
    float* out = belief(lane, t);
    if (!smoothing) p_.log_norm[row(lane) + t] = norms[t];
    std::fill_n(out, N_, 0.0f);
    if (arrival(lane, t) == kPadding) continue;
    const int32_t how = smoothing ? departure(lane, t) : kPadding;
    if (how >= 0) log_product(weight.data(), trans(how), N_, 1, N_, future.data());
    else std::fill(future.begin(), future.end(), 0.0);
    const double* now = &log_belief[t * N_];
    for (Index n = 0; n < N_; ++n) joint[n] = std::max(now[n] + future[n], kNone);
    const double norm = log_sum_exp(joint.data(), N_);
    if (how >= 0 && norm > kNoneBelow) exact_counts(now, weight.data(), norm, how, xi);
    for (Index n = 0; n < N_; ++n) {
      if (joint[n] > kNoneBelow) out[n] = std::exp(joint[n] - norm);
      if (smoothing && arrival(lane, t) == kStart) initial[n] += out[n];
      weight[n] = std::max(future[n] + (norms[t] > kNoneBelow ? log_obs(lane, t)[n] : 0), kNone);
    }
  }
  if (!smoothing) return;
  double& evidence = evidence_[lane] = 0;
  for (double norm : norms) evidence += norm;
  p_.evidence[p_.B * model_ + first_row_ + lane] = evidence;
}

}  // namespace
