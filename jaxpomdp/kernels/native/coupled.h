// Two coupled chains: forward and backward over pairs of states, tape by tape, and the expected moves of each.
//
// Given a pair, the chains move by themselves: T(p, q) = T_0(p, i') T_1(p, j') for q = (i', j'). So each pass is
// one small matrix product for each step, over pairs by one chain's states, and T is never written down. Pairs
// p = (i, j) are numbered i N_1 + j; the second chain's states lie side by side in vectors.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "tapes.h"
#include "threads.h"
#include "vectors.h"

namespace {

// A batch of two coupled chains; each array has an entry for each.
struct CoupledProblem : Batch {
  Index N[2];
  const float *init[2], *trans[2], *log_obs[2];
  float *evidence, *gamma[2];
};

// Where a unit's counts go: xi[c] is [A, N_0, N_1, N_c], initial[c] is [N_c].
struct CoupledCounts {
  float *xi[2], *initial[2];
};

// Rows of a matrix `ld` numbers apart, as `multiply` takes them.
template <class Number>
std::vector<Number*> rows_of(Number* first, Index ld, Index count) {
  std::vector<Number*> rows(count);
  for (Index i = 0; i < count; ++i) rows[i] = first + i * ld;
  return rows;
}

// One thread's workplace: it takes chunks of tapes of a model one after the other.
class CoupledWorker {
 public:
  static constexpr Index kChunk = 4;  // tapes
  static double multiplications(const CoupledProblem& p) {
    const double pairs = p.N[0] * p.N[1];
    return 3.0 * p.S * p.B * p.T * (pairs + 32) * pairs;
  }

  explicit CoupledWorker(const CoupledProblem& problem)
      : p_(problem), one_(problem.N[0]), two_(problem.N[1]), pairs_(one_ * two_), T_(problem.T) {
    row_vecs_ = (two_ + kWidth - 1) / kWidth, pair_vecs_ = (pairs_ + kWidth - 1) / kWidth;
    row_ld_ = row_vecs_ * kWidth;
    ld_ = (pair_vecs_ | 1) * kWidth;  // an odd number of vectors: rows spread over all cache sets
    by_pair_.resize(p_.A * pairs_ * row_ld_);
    for (int c = 0; c < 2; ++c) {
      seen_[c].resize(T_ * p_.N[c]);
      for (Floats* f : {&by_state_[c], &counts_[c]}) f->resize(p_.A * p_.N[c] * ld_);
    }
    for (Floats* f : {&start_, &now_}) f->resize(one_ * row_ld_);
    for (Floats* f : {&weighted_, &ahead_}) f->resize(one_ * ld_);
    for (Floats* f : {&beta_, &future_}) f->resize(ld_);
    belief_.resize(T_ * ld_);
    marginal_.resize(row_ld_);
    norm_.resize(T_);
    weighted_rows_ = rows_of<const float>(weighted_ + 0, ld_, one_);
    now_rows_ = rows_of(now_ + 0, row_ld_, one_);
    ahead_rows_ = rows_of(ahead_ + 0, ld_, one_);
    future_rows_ = rows_of<const float>(future_ + 0, two_, one_);
    future_columns_ = rows_of<const float>(future_ + 0, 1, two_);
  }

  // Writes gammas and evidence; what is summed over these tapes goes to `out`.
  void smooth(Index unit, CoupledCounts out) {
    enter(unit);
    std::vector<char> failed(p_.rows(unit), false);
    const Index first = p_.first_row(unit) + model_ * p_.B, tapes = failed.size();
    for (bool again = true; again;) {  // once more without the tapes whose underflow showed only on the way back
      again = false;
      clear(out);
      for (Index i = 0; i < tapes; ++i) {
        tape_ = first + i;
        if (failed[i]) continue;
        if (!forward()) failed[i] = true;
        else if (!backward(out)) failed[i] = again = true;
      }
    }
    for (int c = 0; c < 2; ++c) scale_counts(c, out.xi[c]);
    for (Index i = 0; i < tapes; ++i)
      if (tape_ = first + i; failed[i]) exact_smooth(out);
  }

 private:
  const float* trans(int c) const { return p_.trans[c] + model_ * p_.A * pairs_ * p_.N[c]; }
  const float* log_obs(int c, Index t) const { return p_.log_obs[c] + (tape_ * T_ + t) * p_.N[c]; }
  float* gamma(int c, Index t) const { return p_.gamma[c] + (tape_ * T_ + t) * p_.N[c]; }
  float* by_state(int c, Index a) { return by_state_[c] + a * p_.N[c] * ld_; }
  int32_t arrival(Index t) const { return p_.arrival(tape_, t); }
  // The action that leads on from a step, or negative at a trial's last.
  int32_t departure(Index t) const { return t + 1 < T_ ? arrival(t + 1) : kPadding; }

  void enter(Index unit) {
    if (model_ == p_.model(unit)) return;
    model_ = p_.model(unit);
    const float *one = p_.init[0] + model_ * one_, *two = p_.init[1] + model_ * two_;
    for (Index i = 0; i < one_; ++i)
      for (Index j = 0; j < two_; ++j) *(start_ + i * row_ld_ + j) = one[i] * two[j];
    for (Index k = 0; k < p_.A * pairs_; ++k)
      std::memcpy(by_pair_ + k * row_ld_, trans(1) + k * two_, two_ * sizeof(float));
    for (int c = 0; c < 2; ++c)
      for (Index a = 0; a < p_.A; ++a)
        for (Index p = 0; p < pairs_; ++p)
          for (Index n = 0; n < p_.N[c]; ++n) by_state(c, a)[n * ld_ + p] = trans(c)[(a * pairs_ + p) * p_.N[c] + n];
  }

  void clear(const CoupledCounts& out) {
    for (int c = 0; c < 2; ++c) counts_[c].clear(), std::fill_n(out.initial[c], p_.N[c], 0.0f);
  }

  // False: not trusted.
  bool forward() {
    Evidence evidence;
    for (Index t = 0; t < T_; ++t) {
      const int32_t how = arrival(t);
      if (how == kPadding) continue;
      if (how >= 0) push(how, belief_ + (t - 1) * ld_);
      const float shift = observe(how >= 0 ? now_ : start_, t);
      if (!(norm_[t] >= kOverlapFloor)) return false;
      evidence.shift(shift), evidence.norm(norm_[t]);
    }
    p_.evidence[tape_] = evidence.total();
    return true;
  }

  // weighted[i', p] = belief_p T_0(p, i').
  void weigh(Index a, const float* belief) {
    for (Index i = 0; i < one_; ++i) {
      const float* table = by_state(0, a) + i * ld_;
      float* out = weighted_ + i * ld_;
      for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) store(out + p, load(belief + p) * load(table + p));
    }
  }

  // now[i', j'] = sum_p belief_p T_0(p, i') T_1(p, j').
  void push(Index a, const float* belief) {
    weigh(a, belief);
    multiply(weighted_rows_.data(), 1, by_pair_ + a * pairs_ * row_ld_, row_ld_, pairs_, now_rows_.data(), one_,
             row_vecs_, false);
  }

  // belief ∝ now * density, which is the product of the chains'; what no pair allows is ignored.
  float observe(const Floats& now, Index t) {
    float* seen[] = {seen_[0] + t * one_, seen_[1] + t * two_};
    float shift = 0;
    for (int c = 0; c < 2; ++c) shift += relative(log_obs(c, t), seen[c], p_.N[c]);
    for (int c = 0; c < 2 && shift < kImpossible; ++c) std::fill_n(seen[c], p_.N[c], 1.0f);
    float* belief = belief_ + t * ld_;
    Vec total{};
    for (Index i = 0; i < one_; ++i)
      sweep(two_, [&](Index j, Index count) {
        const Vec joint = load(now + i * row_ld_ + j) * load_first(seen[1] + j, count, 0) * splat(seen[0][i]);
        total += joint;
        store_first(belief + i * two_ + j, count, joint);
      });
    norm_[t] = sum(total);
    if (!(norm_[t] >= kOverlapFloor)) return shift;  // not trusted; by zero, what lies behind the pairs turns NaN
    const Vec scale = splat(1 / norm_[t]);
    for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) store(belief + p, load(belief + p) * scale);
    return shift;
  }

  // False: not trusted, and part of the tape has been counted.
  bool backward(const CoupledCounts& out) {
    for (Index t = T_ - 1; t >= 0; --t) {
      const int32_t how = arrival(t), next = departure(t);
      if (how == kPadding) {
        for (int c = 0; c < 2; ++c) std::fill_n(gamma(c, t), p_.N[c], 0.0f);
        continue;
      }
      if (next >= 0) pull(next, belief_ + t * ld_);
      else std::fill_n(beta_ + 0, pairs_, 1.0f);
      if (!combine(t)) return false;
      for (int c = 0; c < 2 && how == kStart; ++c)
        for (Index n = 0; n < p_.N[c]; ++n) out.initial[c][n] += gamma(c, t)[n];
    }
    return true;
  }

  // beta_p = sum_i' T_0(p, i') ahead(p, i'), where ahead(p, i') = sum_j' T_1(p, j') future(i', j'); counts, without
  // the probability of the chain's own move: belief_p ahead(p, i'), and belief_p sum_i' T_0(p, i') future(i', j').
  void pull(Index a, const float* belief) {
    weigh(a, belief);
    count_rows_ = rows_of(counts_[1] + a * two_ * ld_, ld_, two_);
    multiply(future_columns_.data(), two_, weighted_ + 0, ld_, one_, count_rows_.data(), two_, pair_vecs_, true);
    multiply(future_rows_.data(), 1, by_state(1, a), ld_, two_, ahead_rows_.data(), one_, pair_vecs_, false);
    const float* table = by_state(0, a);
    float* count = counts_[0] + a * one_ * ld_;
    for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) {
      const Vec share = load(belief + p);
      Vec beta{};
      for (Index at = p; at < one_ * ld_; at += ld_) {
        const Vec ahead = load(ahead_ + at);
        store(count + at, load(count + at) + share * ahead);
        beta += load(table + at) * ahead;
      }
      store(beta_ + p, beta);
    }
  }

  // gamma = belief beta / overlap, summed to each chain's; future = density beta over the overlap of prediction
  // and future, so that moves count in full. False: not trusted.
  bool combine(Index t) {
    const float* belief = belief_ + t * ld_;
    Vec both{}, top{};
    for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) {
      both += load(belief + p) * load(beta_ + p);
      top = larger(top, load(beta_ + p));
    }
    const float overlap = sum(both);
    if (!(overlap * norm_[t] >= kOverlapFloor * peak(top))) return false;
    const Vec share = splat(1 / overlap), onward = splat(1 / (overlap * norm_[t]));
    const float *one = seen_[0] + t * one_, *two = seen_[1] + t * two_;
    marginal_.clear();
    for (Index i = 0; i < one_; ++i) {
      Vec total{};
      sweep(two_, [&](Index j, Index count) {
        const Index p = i * two_ + j;
        const Vec beta = load_first(beta_ + p, count, 0), here = load_first(belief + p, count, 0) * beta * share;
        total += here;
        store(marginal_ + j, load(marginal_ + j) + here);
        store_first(future_ + p, count, beta * onward * load_first(two + j, count, 0) * splat(one[i]));
      });
      gamma(0, t)[i] = sum(total);
    }
    std::memcpy(gamma(1, t), marginal_ + 0, two_ * sizeof(float));
    return true;
  }

  void scale_counts(int c, float* xi) {
    for (Index a = 0; a < p_.A; ++a)
      for (Index p = 0; p < pairs_; ++p)
        for (Index n = 0; n < p_.N[c]; ++n, ++xi) {
          const Index at = (a * p_.N[c] + n) * ld_ + p;
          *xi = *(counts_[c] + at) * *(by_state_[c] + at);
        }
  }

  // In coupled_exact.h.
  struct Tape;
  void exact_smooth(const CoupledCounts& out);

  const CoupledProblem& p_;
  const Index one_, two_, pairs_, T_;
  Index row_vecs_, pair_vecs_, row_ld_, ld_, model_ = -1, tape_ = 0;
  Floats by_pair_, by_state_[2], counts_[2];  // [A, pairs, row_ld]; [A, N_c, ld], as the counts
  Floats start_, now_;                        // [N_0, row_ld]
  Floats weighted_, ahead_;                   // [N_0, ld]
  Floats belief_, seen_[2];                   // [T, ld]; densities [T, N_c]
  Floats beta_, future_, marginal_;
  std::vector<float> norm_;
  std::vector<const float*> weighted_rows_, future_rows_, future_columns_;
  std::vector<float*> now_rows_, ahead_rows_, count_rows_;
};

}  // namespace
