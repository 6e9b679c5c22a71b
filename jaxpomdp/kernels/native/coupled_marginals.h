// Two coupled chains, approximately: forward and backward over each chain's marginals, and the expected moves.
//
// A step's belief is the product of the chains'; it is written down over pairs of states when it is needed, and
// nothing is larger than the tables. Tapes of a model run in step: those that took the same action share one
// small matrix product. The states of both chains lie side by side in a row, the second's after the first's, and
// so do their moves, [pairs, states]: one product serves both. Pairs (i, j) are numbered i N_1 + j.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "coupled.h"
#include "tapes.h"
#include "threads.h"
#include "vectors.h"

namespace {

// Scales a row so that its largest entry is one; a row of zeros becomes ones: it says nothing.
inline void scale_to_one(float* row, Index N) {
  Vec best{};
  sweep(N, [&](Index n, Index count) { best = larger(best, load_first(row + n, count, 0)); });
  const float top = peak(best);
  if (!(top > 0)) return (void)std::fill_n(row, N, 1.0f);
  sweep(N, [&](Index n, Index count) { store_first(row + n, count, load_first(row + n, count, 0) / splat(top)); });
}

// One thread's workplace: it takes chunks of tapes of a model one after the other.
class MarginalWorker {
 public:
  static constexpr Index kChunk = 16;  // tapes
  static double multiplications(const CoupledProblem& p) {
    return 3.0 * p.S * p.B * p.T * p.N[0] * p.N[1] * (p.N[0] + p.N[1] + 8);
  }

  explicit MarginalWorker(const CoupledProblem& problem)
      : p_(problem), one_(problem.N[0]), two_(problem.N[1]), N_(one_ + two_), pairs_(one_ * two_), T_(problem.T) {
    state_vecs_ = (N_ + kWidth - 1) / kWidth, pair_vecs_ = (pairs_ + kWidth - 1) / kWidth;
    table_ld_ = state_vecs_ * kWidth;
    row_ld_ = table_ld_ + kWidth;             // the second chain's states may be read by whole vectors
    ld_ = ((pair_vecs_ + 1) | 1) * kWidth;    // as pairs may, and rows spread over all cache sets
    by_pair_.resize(p_.A * pairs_ * table_ld_);
    for (Floats* f : {&by_state_, &counts_}) f->resize(p_.A * N_ * ld_);
    for (Floats* f : {&init_, &beta_, &mean_}) f->resize(row_ld_);
    for (Floats* f : {&belief_, &density_}) f->resize(p_.chunk_rows * T_ * row_ld_);
    for (Floats* f : {&now_, &future_}) f->resize(p_.chunk_rows * row_ld_);
    for (Floats* f : {&joint_, &promise_[0], &promise_[1]}) f->resize(p_.chunk_rows * ld_);
    for (Floats& f : leaving_) f.resize(p_.A * kBlock * ld_);
    arriving_.resize(p_.A * kBlock * row_ld_);
    both_.resize(ld_);
    groups_.resize(p_.A), promised_.resize(p_.A);
    for (auto* groups : {&groups_, &promised_})
      for (Group& g : *groups) g.from.resize(p_.chunk_rows), g.to.resize(p_.chunk_rows);
    filled_.assign(p_.A, 0);
  }

  // Writes gammas and evidence; what is summed over these tapes goes to `out`.
  void smooth(Index unit, CoupledCounts out) {
    enter(unit);
    counts_.clear();
    for (int c = 0; c < 2; ++c) {
      std::fill_n(out.initial[c], p_.N[c], 0.0f);
      std::fill_n(out.xi[c], p_.A * pairs_ * p_.N[c], 0.0f);
    }
    forward();
    backward(out);
    for (int c = 0; c < 2; ++c) add_counts(c, out.xi[c]);
  }

 private:
  Index first(int c) const { return c == 0 ? 0 : one_; }  // of a chain's states, among both chains'
  Index tape(Index lane) const { return model_ * p_.B + first_tape_ + lane; }
  const float* trans(int c, Index a) const { return p_.trans[c] + (model_ * p_.A + a) * pairs_ * p_.N[c]; }
  const float* log_obs(int c, Index lane, Index t) const { return p_.log_obs[c] + (tape(lane) * T_ + t) * p_.N[c]; }
  float* gamma(int c, Index lane, Index t) const { return p_.gamma[c] + (tape(lane) * T_ + t) * p_.N[c]; }
  float* belief(Index lane, Index t) { return belief_ + (lane * T_ + t) * row_ld_; }
  float* density(Index lane, Index t) { return density_ + (lane * T_ + t) * row_ld_; }
  int32_t arrival(Index lane, Index t) const { return p_.arrival(tape(lane), t); }
  // The action that leads on from a step, or negative at a trial's last.
  int32_t departure(Index lane, Index t) const { return t + 1 < T_ ? arrival(lane, t + 1) : kPadding; }

  void enter(Index unit) {
    first_tape_ = p_.first_row(unit), lanes_ = p_.rows(unit);
    evidence_.assign(lanes_, {});
    if (model_ == p_.model(unit)) return;
    model_ = p_.model(unit);
    for (int c = 0; c < 2; ++c) {
      std::memcpy(init_ + first(c), p_.init[c] + model_ * p_.N[c], p_.N[c] * sizeof(float));
      const float* from = trans(c, 0);
      for (Index k = 0; k < p_.A * pairs_; ++k, from += p_.N[c]) {
        std::memcpy(by_pair_ + k * table_ld_ + first(c), from, p_.N[c] * sizeof(float));
        float* to = by_state_ + (k / pairs_ * N_ + first(c)) * ld_ + k % pairs_;
        for (Index n = 0; n < p_.N[c]; ++n) to[n * ld_] = from[n];
      }
    }
  }

  void forward() {
    for (Index t = 0; t < T_; ++t) {
      for (Index lane = 0; lane < lanes_; ++lane) {
        const int32_t how = arrival(lane, t);
        float *now = now_ + lane * row_ld_, *joint = joint_ + lane * ld_;
        if (how == kStart) std::memcpy(now, init_ + 0, N_ * sizeof(float));
        if (how < 0) continue;
        join(belief(lane, t - 1), joint);
        groups_[how].add(joint, now);
      }
      for (Index a = 0; a < p_.A; ++a)
        multiply_group(groups_[a], by_pair_ + a * pairs_ * table_ld_, table_ld_, pairs_, state_vecs_);
      for (Index lane = 0; lane < lanes_; ++lane)
        for (int c = 0; c < 2 && arrival(lane, t) != kPadding; ++c) observe(lane, t, c);
    }
    for (Index lane = 0; lane < lanes_; ++lane)
      p_.evidence[tape(lane)] = evidence_[lane].total();
  }

  static void multiply_group(Group& g, const float* matrix, Index ld, Index depth, Index vecs) {
    if (g.size > 0) multiply(g.from.data(), 1, matrix, ld, depth, g.to.data(), g.size, vecs, false);
    g.size = 0;
  }

  // joint = the product of the chains' beliefs; zeros follow the last pair.
  void join(const float* belief, float* joint) const {
    for (Index i = 0; i < one_; ++i) {
      const Vec share = splat(belief[i]);
      for (Index j = 0; j < two_; j += kWidth) store(joint + i * two_ + j, share * load(belief + one_ + j));
    }
  }

  // belief ∝ now * density; the density of what was seen is over its largest within reach. What a chain cannot have
  // emitted is ignored there.
  void observe(Index lane, Index t, int c) {
    const Index N = p_.N[c];
    const float *row = log_obs(c, lane, t), *now = now_ + lane * row_ld_ + first(c);
    float *seen = density(lane, t) + first(c), *to = belief(lane, t) + first(c);
    fetch(log_obs(c, lane, std::min(t + 1, T_ - 1)), N);
    auto within_reach = [&](Index n, Index count) {
      return load_first(now + n, count, 0) > Vec{} ? load_first(row + n, count, kNeg) : splat(kNeg);
    };
    Vec best = splat(kNeg), total{};
    sweep(N, [&](Index n, Index count) { best = larger(best, within_reach(n, count)); });
    const float shift = peak(best);
    evidence_[lane].shift(shift);
    if (shift < kImpossible) {
      std::memcpy(to, now, N * sizeof(float));
      std::fill_n(seen, N, 1.0f);
      return;
    }
    sweep(N, [&](Index n, Index count) {
      const Vec here = exp_negative(within_reach(n, count) - splat(shift));
      total += load_first(now + n, count, 0) * here;
      store_first(seen + n, count, here);
    });
    const float norm = sum(total);
    if (norm >= kOverlapFloor) {
      sweep(N, [&](Index n, Index count) {
        store_first(to + n, count, load_first(now + n, count, 0) * load_first(seen + n, count, 0) / splat(norm));
      });
      evidence_[lane].norm(norm);
    } else {
      observe_in_double(lane, row, shift, now, to, N);
    }
  }

  // The product of a small probability and a small density may be below the smallest float, but no double.
  void observe_in_double(Index lane, const float* row, float shift, const float* now, float* to, Index N) {
    std::vector<double> joint(N);
    double norm = 0;
    for (Index n = 0; n < N; ++n) norm += joint[n] = now[n] > 0 ? now[n] * std::exp((double)row[n] - shift) : 0;
    for (Index n = 0; n < N; ++n) to[n] = joint[n] / norm;
    evidence_[lane].norm(norm);
  }

  void backward(const CoupledCounts& out) {
    for (Index t = T_ - 1; t >= 0; --t) {
      take_promises(t);
      for (Index lane = 0; lane < lanes_; ++lane) step_back(lane, t, out);
    }
    for (Index a = 0; a < p_.A; ++a) count_block(a);
  }

  // promise_c[p] = sum_n T_c(p, n) future_c(n), for each chain.
  void take_promises(Index t) {
    for (Index lane = 0; lane < lanes_; ++lane) {
      const int32_t next = departure(lane, t);
      if (next < 0) continue;
      groups_[next].add(future_ + lane * row_ld_, promise_[0] + lane * ld_);
      promised_[next].add(future_ + lane * row_ld_ + one_, promise_[1] + lane * ld_);
    }
    for (Index a = 0; a < p_.A; ++a) {
      multiply_group(groups_[a], by_state_ + a * N_ * ld_, ld_, one_, pair_vecs_);
      multiply_group(promised_[a], by_state_ + (a * N_ + one_) * ld_, ld_, two_, pair_vecs_);
    }
  }

  void step_back(Index lane, Index t, const CoupledCounts& out) {
    const int32_t how = arrival(lane, t), next = departure(lane, t);
    if (how == kPadding) {
      for (int c = 0; c < 2; ++c) std::fill_n(gamma(c, lane, t), p_.N[c], 0.0f);
      return;
    }
    if (next < 0) std::fill_n(beta_ + 0, N_, 1.0f);
    else if (!move(lane, t, next)) move_in_double(lane, t, next, out);
    for (int c = 0; c < 2; ++c) {
      combine(lane, t, c);
      for (Index n = 0; n < p_.N[c] && how == kStart; ++n) out.initial[c][n] += gamma(c, lane, t)[n];
    }
  }

  // beta_c = the promises of both chains, averaged over the other's belief; the two sides of both moves, for the
  // counts, are noted. False: not trusted, and nothing was noted.
  bool move(Index lane, Index t, Index a) {
    const float *here = belief(lane, t), *promise[] = {promise_[0] + lane * ld_, promise_[1] + lane * ld_};
    float* joint = joint_ + lane * ld_;
    join(here, joint);
    Vec overlap{};
    for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) {
      const Vec both = load(promise[0] + p) * load(promise[1] + p);
      overlap += load(joint + p) * both;
      store(both_ + p, both);
    }
    const float total = sum(overlap);
    if (!(total >= kOverlapFloor)) return false;
    const Index slot = a * kBlock + filled_[a];
    const Vec share = splat(1 / total);
    float* leaving[] = {leaving_[0] + slot * ld_, leaving_[1] + slot * ld_};
    for (Index p = 0; p < pair_vecs_ * kWidth; p += kWidth) {
      const Vec scaled = load(joint + p) * share;
      store(leaving[0] + p, scaled * load(promise[1] + p));
      store(leaving[1] + p, scaled * load(promise[0] + p));
    }
    std::memcpy(arriving_ + slot * row_ld_, future_ + lane * row_ld_, N_ * sizeof(float));
    average(here);
    if (++filled_[a] == kBlock) count_block(a);
    return true;
  }

  // beta_0(i) = sum_j belief_1(j) both(i, j), beta_1(j) = sum_i belief_0(i) both(i, j); zero where a chain cannot be.
  void average(const float* here) {
    const float* second = here + one_;
    mean_.clear();
    for (Index i = 0; i < one_; ++i) {
      const float* row = both_ + i * two_;
      const Vec share = splat(here[i]);
      Vec total{};
      for (Index j = 0; j < two_; j += kWidth) {
        const Vec both = load(row + j);
        total += load(second + j) * both;  // zeros follow the last state
        store(mean_ + j, load(mean_ + j) + share * both);
      }
      *(beta_ + i) = here[i] > 0 ? sum(total) : 0;
    }
    sweep(two_, [&](Index j, Index count) {
      store_first(beta_ + one_ + j, count, load(second + j) > Vec{} ? load(mean_ + j) : Vec{});
    });
    for (int c = 0; c < 2; ++c) scale_to_one(beta_ + first(c), p_.N[c]);
  }

  // The same where all that is left is so improbable that products of floats would be lost; counts go to `out`.
  void move_in_double(Index lane, Index t, Index a, const CoupledCounts& out) {
    const float *here = belief(lane, t), *future = future_ + lane * row_ld_;
    std::vector<double> promise[] = {promise_in_double(0, a, future), promise_in_double(1, a, future + one_)};
    std::vector<double> beta(N_, 0.0);
    double total = 0, top = 0;
    for (Index p = 0; p < pairs_; ++p) {
      const double both = promise[0][p] * promise[1][p];
      total += (double)here[p / two_] * here[one_ + p % two_] * both, top = std::max(top, both);
    }
    for (Index p = 0; p < pairs_; ++p) {
      const Index i = p / two_, j = one_ + p % two_;
      const double both = top > 0 ? promise[0][p] * promise[1][p] / top : 1;
      if (here[i] > 0) beta[i] += here[j] * both;
      if (here[j] > 0) beta[j] += here[i] * both;
    }
    for (int c = 0; c < 2; ++c) {
      const double* from = beta.data() + first(c);
      const double most = *std::max_element(from, from + p_.N[c]);
      for (Index n = 0; n < p_.N[c]; ++n) *(beta_ + first(c) + n) = most > 0 ? from[n] / most : 1;
    }
    if (!(total > 0)) return;  // the chains cannot go on as they did: such a move is not counted
    for (int c = 0; c < 2; ++c)
      for (Index p = 0; p < pairs_; ++p) {
        const double leaving = (double)here[p / two_] * here[one_ + p % two_] * promise[1 - c][p] / total;
        const Index at = p * p_.N[c];
        for (Index n = 0; n < p_.N[c]; ++n)
          out.xi[c][a * pairs_ * p_.N[c] + at + n] += leaving * trans(c, a)[at + n] * future[first(c) + n];
      }
  }

  std::vector<double> promise_in_double(int c, Index a, const float* future) const {
    std::vector<double> promise(pairs_, 0.0);
    const float* from = trans(c, a);
    for (Index p = 0; p < pairs_; ++p, from += p_.N[c])
      for (Index n = 0; n < p_.N[c]; ++n) promise[p] += (double)from[n] * future[n];
    return promise;
  }

  // gamma ∝ belief beta; what the step before is promised, density beta.
  void combine(Index lane, Index t, int c) {
    const Index N = p_.N[c];
    const float *here = belief(lane, t) + first(c), *seen = density(lane, t) + first(c), *beta = beta_ + first(c);
    float *future = future_ + lane * row_ld_ + first(c), *out = gamma(c, lane, t);
    fetch_to_write(gamma(c, lane, std::max<Index>(t - 1, 0)), N);
    Vec mass{};
    sweep(N, [&](Index n, Index count) {
      const Vec weight = load_first(beta + n, count, 0), joint = load_first(here + n, count, 0) * weight;
      mass += joint;
      store_first(out + n, count, joint);
      store_first(future + n, count, load_first(seen + n, count, 0) * weight);
    });
    const float total = sum(mass);
    sweep(N, [&](Index n, Index count) {
      const Vec joint = total > 0 ? load_first(out + n, count, 0) / splat(total) : load_first(here + n, count, 0);
      store_first(out + n, count, joint);
    });
    scale_to_one(future, N);
  }

  // counts[a] += arriving^T leaving over the block, for each chain.
  void count_block(Index a) {
    for (int c = 0; c < 2; ++c) {
      const auto from = rows_of<const float>(arriving_ + a * kBlock * row_ld_ + first(c), 1, p_.N[c]);
      const auto to = rows_of(counts_ + (a * N_ + first(c)) * ld_, ld_, p_.N[c]);
      multiply(from.data(), row_ld_, leaving_[c] + a * kBlock * ld_, ld_, filled_[a], to.data(), p_.N[c], pair_vecs_,
               true);
    }
    filled_[a] = 0;
  }

  void add_counts(int c, float* xi) {
    for (Index k = 0; k < p_.A * pairs_; ++k) {
      const Index at = (k / pairs_ * N_ + first(c)) * ld_ + k % pairs_;
      const float *count = counts_ + at, *table = by_state_ + at;
      for (Index n = 0; n < p_.N[c]; ++n, ++xi) *xi += count[n * ld_] * table[n * ld_];
    }
  }

  const CoupledProblem& p_;
  const Index one_, two_, N_, pairs_, T_;
  Index state_vecs_, pair_vecs_, table_ld_, row_ld_, ld_, model_ = -1, first_tape_ = 0, lanes_ = 0;
  Floats by_pair_, by_state_, counts_;             // [A, pairs, table_ld]; [A, states, ld], as the counts
  Floats init_, beta_, mean_, both_;               // [row_ld]; [ld]
  Floats belief_, density_;                        // [lanes, T, row_ld]
  Floats now_, future_, joint_, promise_[2];       // [lanes, row_ld]; [lanes, ld]
  Floats leaving_[2], arriving_;                   // [A, kBlock, ld]; [A, kBlock, row_ld]
  std::vector<Group> groups_, promised_;
  std::vector<Index> filled_;
  std::vector<Evidence> evidence_;
};

}  // namespace
