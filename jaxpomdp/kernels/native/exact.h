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

// The route itself, the same for any chain. A tape says how each step is reached (`arrival`) and left
// (`departure`), reads log-densities, pushes log-beliefs on by an action, pulls log-futures back, counts the
// moves of a step, and takes the marginals of each step in.

// Log-beliefs [T, N] of a tape; returns its log-normalisers [T], kNone where the observation is ignored.
template <class Tape>
std::vector<double> exact_forward(const Tape& tape, std::vector<double>& log_belief) {
  const Index T = tape.steps(), N = tape.states();
  std::vector<double> norms(T, 0.0), predicted(N), joint(N);
  for (Index t = 0; t < T; ++t) {
    const int32_t how = tape.arrival(t);
    if (how == kPadding) continue;
    if (how >= 0) tape.push(how, &log_belief[(t - 1) * N], predicted.data());
    else tape.begin(predicted.data());
    tape.read(t, joint.data());
    for (Index n = 0; n < N; ++n) joint[n] = std::max(predicted[n] + joint[n], kNone);
    norms[t] = log_sum_exp(joint.data(), N);
    const bool heeded = norms[t] > kNoneBelow;
    if (!heeded) norms[t] = kNone;
    for (Index n = 0; n < N; ++n)
      log_belief[t * N + n] = heeded ? std::max(joint[n] - norms[t], kNone) : predicted[n];
  }
  return norms;
}

// The tape takes in the marginals of all steps and what is counted; returns its log-evidence.
template <class Tape>
double exact_smooth_tape(const Tape& tape) {
  const Index T = tape.steps(), N = tape.states();
  std::vector<double> log_belief(T * N, kNone), future(N), weight(N), joint(N), row(N);
  const std::vector<double> norms = exact_forward(tape, log_belief);
  double evidence = 0;
  for (Index t = T - 1; t >= 0; --t) {
    if (tape.arrival(t) == kPadding) {
      std::fill(joint.begin(), joint.end(), 0.0);
      tape.take(t, joint.data());
      continue;
    }
    const int32_t how = tape.departure(t);
    if (how >= 0) tape.pull(how, weight.data(), future.data());
    else std::fill(future.begin(), future.end(), 0.0);
    const double* now = &log_belief[t * N];
    for (Index n = 0; n < N; ++n) joint[n] = std::max(now[n] + future[n], kNone);
    const double norm = log_sum_exp(joint.data(), N);
    if (how >= 0 && norm > kNoneBelow) tape.count(how, now, weight.data(), norm);
    tape.read(t, row.data());
    for (Index n = 0; n < N; ++n) {
      joint[n] = joint[n] > kNoneBelow ? std::exp(joint[n] - norm) : 0;
      weight[n] = std::max(future[n] + (norms[t] > kNoneBelow ? row[n] : 0), kNone);
    }
    tape.take(t, joint.data());
    evidence += norms[t];
  }
  return evidence;
}

inline double log_or_none(double probability) { return probability > 0 ? std::log(probability) : kNone; }

// A row of a flat chain, as the exact route sees it.
struct Worker::Row {
  const Worker& worker;
  Index lane;
  float *xi, *initial;

  Index steps() const { return worker.T_; }
  Index states() const { return worker.N_; }
  int32_t arrival(Index t) const { return worker.arrival(lane, t); }
  int32_t departure(Index t) const { return worker.departure(lane, t); }
  void begin(double* out) const {
    for (Index n = 0; n < states(); ++n) out[n] = log_or_none(*(worker.init_ + n));
  }
  void read(Index t, double* out) const { std::copy_n(worker.log_obs(lane, t), states(), out); }
  void push(Index a, const double* x, double* out) const { product(worker.trans_, a, x, out); }
  void pull(Index a, const double* x, double* out) const { product(worker.back_, a, x, out); }
  void product(const Floats& matrices, Index a, const double* x, double* out) const {
    log_product(x, matrices + a * states() * worker.ld_, worker.ld_, states(), out);
  }
  void count(Index a, const double* x, const double* y, double norm) const {
    add_pairs(x, y, norm, worker.trans(a), states(), xi + a * states() * states());
  }
  void take(Index t, const double* gamma) const {
    std::copy_n(gamma, states(), worker.belief(lane, t));
    for (Index n = 0; n < states() && arrival(t) == kStart; ++n) initial[n] += gamma[n];
  }
};

void Worker::exact_filter(Index lane) {
  std::vector<double> log_belief(T_ * N_, kNone);
  const std::vector<double> norms = exact_forward(Row{*this, lane, nullptr, nullptr}, log_belief);
  for (Index t = 0; t < T_; ++t) {
    p_.log_norm[row(lane) * T_ + t] = norms[t];
    for (Index n = 0; n < N_; ++n) belief(lane, t)[n] = std::exp(log_belief[t * N_ + n]);
  }
}

// Gamma and evidence of a row; its counts are added to xi and initial.
void Worker::exact_smooth(Index lane, float* xi, float* initial) {
  p_.evidence[row(lane)] = exact_smooth_tape(Row{*this, lane, xi, initial});
}

}  // namespace
