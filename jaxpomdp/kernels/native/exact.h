// The exact route: a whole row in logarithms and double precision, for what float32 probabilities cannot hold.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "tapes.h"

namespace {

constexpr double kNone = -1e30, kNoneBelow = -5e29;  // the logarithm of zero; what lies below stands for it

inline double largest(const double* x, Index count) { return *std::max_element(x, x + count); }

double log_sum_exp(const double* x, Index count) {
  const double best = largest(x, count);
  double total = 0;
  if (best < kNoneBelow) return kNone;
  for (Index i = 0; i < count; ++i) total += std::exp(x[i] - best);
  return best + std::log(total);
}

// out_j = log sum_i exp(x_i) m[i, j]: by a product, and term by term where that would underflow.
void log_product(const double* x, const float* m, Index ld, Index N, double* out) {
  const double best = largest(x, N);
  std::vector<double> term(N);
  std::fill_n(out, N, 0.0);
  for (Index i = 0; i < N && best > kNoneBelow; ++i) {
    const double weight = std::exp(x[i] - best);
    for (Index j = 0; j < N && weight > 0; ++j) out[j] += weight * m[i * ld + j];
  }
  for (Index j = 0; j < N; ++j) {
    if (out[j] > 1e-280) {
      out[j] = best + std::log(out[j]);
      continue;
    }
    for (Index i = 0; i < N; ++i) {
      const double step = m[i * ld + j];
      term[i] = step > 0 ? std::max(x[i] + std::log(step), kNone) : kNone;
    }
    out[j] = log_sum_exp(term.data(), N);
  }
}

// xi[i, j] += exp(x_i + y_j - norm) m[i, j]: by a product, and term by term where that would overflow.
void add_pairs(const double* x, const double* y, double norm, const float* m, Index N, float* xi) {
  const double best_x = largest(x, N), best_y = largest(y, N), common = best_x + best_y - norm;
  std::vector<double> right(N);
  for (Index j = 0; j < N; ++j) right[j] = std::exp(y[j] - best_y);
  for (Index i = 0; i < N; ++i, m += N, xi += N) {
    const double left = std::exp(x[i] - best_x + std::min(common, 500.0));
    if (common <= 500)
      for (Index j = 0; j < N; ++j) xi[j] += left * right[j] * m[j];
    else if (x[i] + best_y - norm > -200)  // less adds nothing that a float could hold
      for (Index j = 0; j < N; ++j)
        if (y[j] > kNoneBelow && m[j] > 0) xi[j] += std::exp(x[i] + y[j] - norm) * m[j];
  }
}

// Log-beliefs [T, N] of a row; returns its log-normalisers [T], kNone where the observation is ignored.
std::vector<double> Worker::exact_forward(Index lane, std::vector<double>& log_belief) const {
  std::vector<double> norms(T_, 0.0), predicted(N_), joint(N_);
  const float* init = p_.init + model_ * N_;
  for (Index t = 0; t < T_; ++t) {
    const int32_t how = arrival(lane, t);
    if (how == kPadding) continue;
    if (how >= 0) log_product(&log_belief[(t - 1) * N_], trans_ + how * N_ * ld_, ld_, N_, predicted.data());
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

void Worker::exact_filter(Index lane) {
  std::vector<double> log_belief(T_ * N_, kNone);
  const std::vector<double> norms = exact_forward(lane, log_belief);
  for (Index t = 0; t < T_; ++t) {
    p_.log_norm[row(lane) + t] = norms[t];
    for (Index n = 0; n < N_; ++n) belief(lane, t)[n] = std::exp(log_belief[t * N_ + n]);
  }
}

// Gamma and evidence of a row; its counts are added to xi and initial.
void Worker::exact_smooth(Index lane, float* xi, float* initial) {
  std::vector<double> log_belief(T_ * N_, kNone), future(N_), weight(N_), joint(N_);
  const std::vector<double> norms = exact_forward(lane, log_belief);
  double evidence = 0;
  for (Index t = T_ - 1; t >= 0; --t) {
    float* gamma = belief(lane, t);
    std::fill_n(gamma, N_, 0.0f);
    if (arrival(lane, t) == kPadding) continue;
    const int32_t how = departure(lane, t);
    if (how >= 0) log_product(weight.data(), back_ + how * N_ * ld_, ld_, N_, future.data());
    else std::fill(future.begin(), future.end(), 0.0);
    const double* now = &log_belief[t * N_];
    for (Index n = 0; n < N_; ++n) joint[n] = std::max(now[n] + future[n], kNone);
    const double norm = log_sum_exp(joint.data(), N_);
    if (how >= 0 && norm > kNoneBelow) add_pairs(now, weight.data(), norm, trans(how), N_, xi + how * N_ * N_);
    for (Index n = 0; n < N_; ++n) {
      if (joint[n] > kNoneBelow) gamma[n] = std::exp(joint[n] - norm);
      if (arrival(lane, t) == kStart) initial[n] += gamma[n];
      weight[n] = std::max(future[n] + (norms[t] > kNoneBelow ? log_obs(lane, t)[n] : 0), kNone);
    }
    evidence += norms[t];
  }
  p_.evidence[p_.B * model_ + first_row_ + lane] = evidence;
}

}  // namespace
