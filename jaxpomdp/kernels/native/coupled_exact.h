// The exact route for two coupled chains: a tape in logarithms and double precision. A row of the pair's transitions
// is written down where it is needed, one at a time.

#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "coupled.h"
#include "exact.h"

namespace {

// A tape of two coupled chains, as the exact route sees it.
struct CoupledWorker::Tape {
  const CoupledWorker& worker;
  const CoupledCounts& out;
  const Index one = worker.one_, two = worker.two_, pairs = worker.pairs_;

  Index steps() const { return worker.T_; }
  Index states() const { return pairs; }
  int32_t arrival(Index t) const { return worker.arrival(t); }
  int32_t departure(Index t) const { return worker.departure(t); }
  const float* row(int c, Index a, Index p) const { return worker.trans(c) + (a * pairs + p) * worker.p_.N[c]; }

  // Calls f(i, j, i N_1 + j) for all pairs.
  template <class F>
  void each(F f) const {
    for (Index i = 0, q = 0; i < one; ++i)
      for (Index j = 0; j < two; ++j, ++q) f(i, j, q);
  }
  void begin(double* to) const {
    const float *first = worker.p_.init[0] + worker.model_ * one, *second = worker.p_.init[1] + worker.model_ * two;
    each([&](Index i, Index j, Index q) { to[q] = log_or_none((double)first[i] * second[j]); });
  }
  void read(Index t, double* to) const {
    const float *first = worker.log_obs(0, t), *second = worker.log_obs(1, t);
    each([&](Index i, Index j, Index q) { to[q] = (double)first[i] + second[j]; });
  }
  void take(Index t, const double* gamma) const {
    float* to[] = {worker.gamma(0, t), worker.gamma(1, t)};
    for (int c = 0; c < 2; ++c) std::fill_n(to[c], worker.p_.N[c], 0.0f);
    each([&](Index i, Index j, Index q) { to[0][i] += gamma[q], to[1][j] += gamma[q]; });
    for (int c = 0; c < 2 && arrival(t) == kStart; ++c)
      for (Index n = 0; n < worker.p_.N[c]; ++n) out.initial[c][n] += to[c][n];
  }

  // Row p of the transitions under action a, [pairs].
  void moves(Index a, Index p, double* to) const {
    const float *first = row(0, a, p), *second = row(1, a, p);
    each([&](Index i, Index j, Index q) { to[q] = (double)first[i] * second[j]; });
  }

  void push(Index a, const double* x, double* to) const {
    const double best = largest(x, pairs);
    std::vector<double> move(pairs), term(pairs);
    std::fill_n(to, pairs, 0.0);
    for (Index p = 0; p < pairs && best > kNoneBelow; ++p) {
      const double weight = std::exp(x[p] - best);
      if (weight == 0) continue;
      moves(a, p, move.data());
      for (Index q = 0; q < pairs; ++q) to[q] += weight * move[q];
    }
    each([&](Index i, Index j, Index q) {
      if (to[q] > 1e-280) {
        to[q] = best + std::log(to[q]);
        return;
      }
      for (Index p = 0; p < pairs; ++p)
        term[p] = std::max(x[p] + log_or_none((double)row(0, a, p)[i] * row(1, a, p)[j]), kNone);
      to[q] = log_sum_exp(term.data(), pairs);
    });
  }

  void pull(Index a, const double* x, double* to) const {
    const double best = largest(x, pairs);
    std::vector<double> move(pairs), right(pairs), term(pairs);
    for (Index q = 0; q < pairs; ++q) right[q] = best > kNoneBelow ? std::exp(x[q] - best) : 0;
    for (Index p = 0; p < pairs; ++p) {
      double total = 0;
      moves(a, p, move.data());
      for (Index q = 0; q < pairs; ++q) total += move[q] * right[q];
      if (total <= 1e-280)
        for (Index q = 0; q < pairs; ++q) term[q] = std::max(x[q] + log_or_none(move[q]), kNone);
      to[p] = total > 1e-280 ? best + std::log(total) : log_sum_exp(term.data(), pairs);
    }
  }

  // Counts exp(x_p + y_q - norm) T(p, q), by a product, and term by term where that would overflow.
  void count(Index a, const double* x, const double* y, double norm) const {
    const double best = largest(y, pairs);
    std::vector<double> right(pairs);
    for (Index q = 0; q < pairs; ++q) right[q] = std::exp(y[q] - best);
    for (Index p = 0; p < pairs; ++p) {
      const double lead = x[p] + best - norm;
      if (lead < -200) continue;  // adds nothing that a float could hold
      const double left = std::exp(std::min(lead, 500.0));
      const float *first = row(0, a, p), *second = row(1, a, p);
      float* xi[] = {out.xi[0] + (a * pairs + p) * one, out.xi[1] + (a * pairs + p) * two};
      each([&](Index i, Index j, Index q) {
        const double move = (double)first[i] * second[j];
        if (move == 0 || y[q] < kNoneBelow) return;
        const double share = lead <= 500 ? left * right[q] * move : std::exp(x[p] + y[q] - norm) * move;
        xi[0][i] += share, xi[1][j] += share;
      });
    }
  }
};

// Gammas and evidence of a tape; its counts are added to `out`.
void CoupledWorker::exact_smooth(const CoupledCounts& out) {
  p_.evidence[tape_] = exact_smooth_tape(Tape{*this, out});
}

}  // namespace
