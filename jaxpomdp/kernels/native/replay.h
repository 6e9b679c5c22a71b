// SARSA(lambda) and Q(lambda) over stored trials, on given beliefs.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "threads.h"
#include "vectors.h"

namespace {

// Models s < S, rows b < B in their order, steps t < T, states n < N, actions a < A.
struct Replay {
  Index S, B, T, N, A;
  const float *q, *beliefs;
  const int32_t* actions;
  const float* rewards;
  const bool *start, *valid, *terminated;
  const float* settings;  // [S, 3]: learning rate, discount, lambda
  float* learnt;          // [S, N, A], as q
  Index passes;
  bool replacing, greedy;
};

// Values and traces of one model, action by action, so that a belief meets contiguous rows.
class Learner {
 public:
  explicit Learner(const Replay& replay) : r_(replay), N_(replay.N) {
    ld_ = (N_ + kWidth - 1) / kWidth * kWidth;
    for (Floats* f : {&q_, &trace_}) f->resize(r_.A * ld_);
    traced_.assign(r_.A, false);
  }

  void learn(Index model) {
    for (Index n = 0; n < N_; ++n)
      for (Index a = 0; a < r_.A; ++a) *(q_ + a * ld_ + n) = r_.q[(model * N_ + n) * r_.A + a];
    for (Index pass = 0; pass < r_.passes; ++pass)
      for (Index row = 0; row < r_.B; ++row) learn_row(model, (model * r_.B + row) * r_.T);
    for (Index n = 0; n < N_; ++n)
      for (Index a = 0; a < r_.A; ++a) r_.learnt[(model * N_ + n) * r_.A + a] = *(q_ + a * ld_ + n);
  }

 private:
  void learn_row(Index model, Index row) {
    const float *set = r_.settings + 3 * model, rate = set[0], discount = set[1], decay = discount * set[2];
    for (Index t = 0; t < r_.T; ++t) {
      const Index at = row + t;
      if (!r_.valid[at]) continue;
      if (t == 0 || r_.start[at] || !r_.valid[at - 1]) std::fill(traced_.begin(), traced_.end(), false);
      if (last(row, t)) continue;
      const Index a = action(at);
      const float delta = r_.rewards[at] + discount * next_value(row, t + 1) - value(at, a);
      mark(at, a, decay);
      for (Index i = 0; i < r_.A; ++i)
        if (traced_[i]) add(q_ + i * ld_, trace_ + i * ld_, rate * delta);
    }
  }

  bool last(Index row, Index t) const { return t + 1 == r_.T || !r_.valid[row + t + 1] || r_.start[row + t + 1]; }
  Index action(Index at) const { return std::clamp<Index>(r_.actions[at], 0, r_.A - 1); }

  // Q(b, a) = sum_n b(n) q(n, a).
  float value(Index at, Index a) const {
    const float *b = r_.beliefs + at * N_, *q = q_ + a * ld_;
    Vec total{};
    sweep(N_, [&](Index n, Index count) { total += load_first(b + n, count, 0) * load(q + n); });
    return sum(total);
  }

  // A trial's last step has no action: nothing more to come if the world ended it, else the best there is.
  float next_value(Index row, Index t) const {
    const bool ends = last(row, t);
    if (ends && r_.terminated[row + t]) return 0;
    if (!ends && !r_.greedy) return value(row + t, action(row + t));
    float best = value(row + t, 0);
    for (Index a = 1; a < r_.A; ++a) best = std::max(best, value(row + t, a));
    return best;
  }

  // trace := decay trace + belief [a = a_t]; an action not yet taken in the trial has no trace.
  void mark(Index at, Index taken, float decay) {
    for (Index a = 0; a < r_.A; ++a)
      if (traced_[a] && a != taken) scale(trace_ + a * ld_, decay);
    const float* b = r_.beliefs + at * N_;
    float* trace = trace_ + taken * ld_;
    const Vec fade = splat(traced_[taken] ? decay : 0);
    sweep(N_, [&](Index n, Index count) {
      const Vec old = load(trace + n) * fade, now = load_first(b + n, count, 0);
      store(trace + n, r_.replacing ? larger(old, now) : old + now);
    });
    traced_[taken] = true;
  }

  void scale(float* x, float by) const {
    for (Index n = 0; n < ld_; n += kWidth) store(x + n, load(x + n) * by);
  }
  void add(float* x, const float* y, float by) const {
    for (Index n = 0; n < ld_; n += kWidth) store(x + n, load(x + n) + load(y + n) * by);
  }

  const Replay& r_;
  const Index N_;
  Index ld_;
  Floats q_, trace_;
  std::vector<char> traced_;
};

}  // namespace
