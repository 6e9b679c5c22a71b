// The exact route for a chain with a memory: a tape in logarithms and double precision, over the same columns.

#pragma once

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "exact.h"
#include "memory.h"

namespace {

inline double log_add(double x, double y) {
  const double best = std::max(x, y);
  return best < kNoneBelow ? kNone : best + std::log1p(std::exp(std::min(x, y) - best));
}

// A tape of a chain with a memory, as the exact route sees it. Pairs are numbered column * N + active state.
struct MemoryWorker::Tape {
  using Numbers = std::vector<double>;

  const MemoryWorker& worker;
  Index lane;
  const MemoryCounts& out;
  const Index N = worker.N_, columns = worker.awake_.size(), rest = columns * N;
  mutable Numbers ahead = Numbers(states(), kNone), noted = Numbers(N, 0.0);  // of the step last pulled and counted

  Index steps() const { return worker.T_; }
  Index states() const { return rest + N; }
  int32_t arrival(Index t) const { return worker.arrival(lane, t); }
  int32_t departure(Index t) const { return worker.departure(lane, t); }
  const Awake& node(Index k) const { return worker.awake_[k]; }
  double led(Index a, Index k, Index n) const { return log_or_none(worker.led(a, k)[n]); }
  // The logarithm of a column's product with a table of [A, N, ld].
  void product(const Floats& table, Index a, const double* x, double* to) const {
    log_product(x, table + a * N * worker.ld_, worker.ld_, N, to);
  }

  void begin(double* to) const {
    for (Index k = 0; k <= columns; ++k)
      for (Index n = 0; n < N; ++n) to[k * N + n] = log_or_none(*(worker.start_ + (k * worker.ld_ + n)));
  }
  void read(Index t, double* to) const {
    for (Index k = 0; k <= columns; ++k) std::copy_n(worker.log_obs(lane, t), N, to + k * N);
  }

  Numbers remember(const double* x) const {
    Numbers pairs(x, x + states());
    for (Index k = 0; k < columns; ++k)
      for (Index n = 0; n < N; ++n) {
        pairs[rest + n] = log_add(pairs[rest + n], x[k * N + n] + log_or_none(node(k).choice[0]));
        pairs[k * N + n] = std::max(x[k * N + n] + log_or_none(node(k).choice[1]), kNone);
      }
    for (Index k = 0; k < columns; ++k) {
      double &pair = pairs[k * N + node(k).state], &let_go = pairs[rest + node(k).state];
      pair = log_add(pair, let_go), let_go = kNone;
    }
    return pairs;
  }

  void push(Index a, const double* x, double* to) const {
    const Numbers pairs = remember(x);
    product(worker.any_, a, &pairs[rest], to + rest);
    for (Index k = 0; k < columns; ++k) {
      const double by_chain = log_or_none(node(k).by[0]), all = log_sum_exp(&pairs[k * N], N);
      product(worker.own_, a, &pairs[k * N], to + k * N);
      for (Index n = 0; n < N; ++n) to[k * N + n] = log_add(to[k * N + n] + by_chain, all + led(a, k, n));
    }
  }

  void pull(Index a, const double* x, double* to) const {
    product(worker.any_back_, a, x + rest, &ahead[rest]);
    for (Index k = 0; k < columns; ++k) {
      Numbers told(N);
      for (Index n = 0; n < N; ++n) told[n] = std::max(x[k * N + n] + led(a, k, n), kNone);
      const double by_chain = log_or_none(node(k).by[0]), by_memory = log_sum_exp(told.data(), N);
      product(worker.own_back_, a, x + k * N, &ahead[k * N]);
      for (Index n = 0; n < N; ++n) ahead[k * N + n] = log_add(ahead[k * N + n] + by_chain, by_memory);
      ahead[rest + node(k).state] = ahead[k * N + node(k).state];
    }
    std::copy_n(&ahead[rest], N, to + rest);
    for (Index k = 0; k < columns; ++k)
      for (Index n = 0; n < N; ++n) to[k * N + n] = log_add(choice(k, 0, n), choice(k, 1, n));
  }
  // What is to come where a column's state is let go for the active one (0), or kept (1).
  double choice(Index k, int which, Index n) const {
    return log_or_none(node(k).choice[which]) + ahead[(which ? k * N : rest) + n];
  }

  void count(Index a, const double* x, const double* y, double norm) const {
    const Numbers pairs = remember(x);
    for (Index k = 0; k <= columns; ++k)
      for (int by = 0; by < 2; ++by) count_moves(a, k, by, &pairs[k * N], y + k * N, norm);
    for (Index k = 0; k < columns; ++k)
      for (int i = 0; i < 2; ++i)
        for (Index n = 0; n < N; ++n)
          out.note[2 * node(k).state + i] += std::exp(std::max(x[k * N + n] + choice(k, i, n) - norm, kNone));
  }

  // Counts the moves of one column, by the chain or by the memory.
  void count_moves(Index a, Index k, int by, const double* pairs, const double* y, double norm) const {
    Numbers left(N);
    std::vector<float> table(N * N), moves(N * N);
    auto remembered = [&](Index active) { return k < columns ? node(k).state : active; };
    for (Index n = 0; n < N; ++n) {
      const float* row = by ? worker.lead(a, remembered(n)) : worker.trans(a) + n * N;
      left[n] = std::max(pairs[n] + log_or_none(worker.heed(remembered(n))[by]), kNone);
      std::copy_n(row, N, &table[n * N]);
    }
    add_pairs(left.data(), y, norm, table.data(), N, moves.data());
    for (Index n = 0, i = 0; n < N; ++n)
      for (Index j = 0; j < N; ++j, ++i) {
        const Index held = remembered(n);
        (by ? out.lead[(a * N + held) * N + j] : out.chain[(a * N + n) * N + j]) += moves[i];
        out.xi[(a * N + n) * N + j] += moves[i];
        out.heed[2 * held + by] += moves[i];
        if (k == columns) noted[n] += moves[i];
      }
  }

  void take(Index t, const double* joint) const {
    float *gamma = worker.gamma(lane, t), *held = worker.held(lane, t);
    std::fill_n(gamma, N, 0.0f), std::fill_n(held, N, 0.0f);
    for (Index k = 0; k <= columns; ++k)
      for (Index n = 0; n < N; ++n) {
        gamma[n] += joint[k * N + n];
        if (k < columns) held[node(k).state] += joint[k * N + n];
        else if (arrival(t) == kStart) held[n] += joint[rest + n];
      }
    for (Index n = 0; n < N && departure(t) >= 0; ++n) worker.held(lane, t + 1)[n] += std::exchange(noted[n], 0.0);
    for (Index n = 0; n < N && arrival(t) == kStart; ++n) out.initial[n] += gamma[n];
  }
};

// Gamma, held and evidence of a row; its counts are added to `out`.
void MemoryWorker::exact_smooth(Index lane, const MemoryCounts& out) {
  p_.evidence[row(lane)] = exact_smooth_tape(Tape{*this, lane, out});
}

}  // namespace
