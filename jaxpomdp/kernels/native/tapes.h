// Forward and backward over rows of one model in step, and expected transitions.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "threads.h"
#include "vectors.h"

namespace {

constexpr Index kChunkRows = 32;
constexpr int32_t kStart = -1, kPadding = -2;

// Tapes of many models: models s < S, rows b < B, steps t < T, actions a < A.
struct Batch {
  Index S, B, T, A;
  const int32_t* actions;
  const bool *start, *valid;
  Index chunks, chunk_rows;

  // Rows of a model are cut into chunks, the same for any number of threads; their counts, so many numbers for
  // each model, may fill 64 MiB.
  void plan_chunks(Index rows, Index counts) {
    const Index affordable = (Index{16} << 20) / std::max<Index>(1, counts * S);
    chunks = std::clamp<Index>((B + rows - 1) / rows, 1, std::max<Index>(16, affordable));
    chunk_rows = (B + chunks - 1) / chunks;
  }
  Index model(Index unit) const { return unit / chunks; }
  Index first_row(Index unit) const { return B * (unit % chunks) / chunks; }
  Index rows(Index unit) const { return B * (unit % chunks + 1) / chunks - first_row(unit); }

  // How a step is reached: by an action, as a trial's start, or not at all.
  int32_t arrival(Index row, Index t) const {
    const Index at = row * T + t;
    if (!valid[at]) return kPadding;
    if (t == 0 || start[at] || !valid[at - 1]) return kStart;
    return std::clamp<int32_t>(actions[at - 1], 0, A - 1);  // as a clamped gather
  }
};

// A batch of flat chains: states n < N.
struct Problem : Batch {
  Index N;
  const float *init, *trans, *log_obs;
  float *belief, *log_norm;  // filter: probabilities and log-normalisers, [S, B, T, N] and [S, B, T]
  float* evidence;           // smoothing, where belief becomes gamma
  bool counted;              // smoothing: count transitions too
};

// Rows that share an action now: where their vectors come from and go to.
struct Group {
  std::vector<const float*> from;
  std::vector<float*> to;
  Index size = 0;
  void add(const float* x, float* out) { from[size] = x, to[size++] = out; }
};

// The log-evidence of a tape, taken in step by step: norms are multiplied, and their logarithm is taken now and then.
struct Evidence {
  double sum = 0, product = 1;
  void shift(float log_density) { sum += log_density < kImpossible ? kNeg : log_density; }
  void norm(double probability) {
    product *= probability;
    if (product < 1e-200) sum += std::log(product), product = 1;
  }
  double total() const { return sum + std::log(product); }
};

constexpr Index kBlock = 64;  // steps whose transitions are counted by one product

// The rows of one time lie far apart, too many streams for the processor to foresee: fetch each a step ahead.
inline void fetch(const float* row, Index N) {
  for (Index n = 0; n < N; n += 16) __builtin_prefetch(row + n);
}
inline void fetch_to_write(const float* row, Index N) {
  for (Index n = 0; n < N; n += 16) __builtin_prefetch(row + n, 1);
}

// What a step's observation came to: the largest log-likelihood, and the probability that remains without it.
struct Observed {
  float shift, norm;
};

// out = now * exp(row - shift) / norm; an observation that no state allows is ignored.
inline Observed observe(const float* row, float* now, float* out, Index N) {
  Vec best = splat(kNeg);
  sweep(N, [&](Index n, Index count) { best = larger(best, load_first(row + n, count, kNeg)); });
  float shift = peak(best);
  if (shift < kImpossible) {
    std::memcpy(out, now, N * sizeof(float));
    return {shift, 1};
  }
  Vec total{}, shifts = splat(shift);
  sweep(N, [&](Index n, Index count) {
    Vec joint = load(now + n) * exp_negative(load_first(row + n, count, kNeg) - shifts);
    total += joint;
    store(now + n, joint);
  });
  float norm = sum(total);
  Vec scale = splat(1 / norm);
  sweep(N, [&](Index n, Index count) { store_first(out + n, count, load(now + n) * scale); });
  return {shift, norm};
}

struct Step {  // what the backward pass reads and writes at one step of one row
  const float *log_obs, *beta;
  float *alpha, *weight, *left, *right;
};

// gamma = alpha beta / overlap in place of alpha; left = alpha / overlap and right = weight, whose product over
// steps counts transitions; then weight ∝ beta * exp(log_obs - shift), for the step before. False: not trusted.
inline bool combine(const Step& at, Observed seen, Index N) {
  const Step s = at;  // a local copy, which stores cannot touch
  const Vec shifts = splat(seen.shift);
  const bool heeded = seen.shift >= kImpossible;
  Vec both{}, mass{};
  sweep(N, [&](Index n, Index count) {
    Vec beta = load(s.beta + n), here = beta;
    both += load_first(s.alpha + n, count, 0) * beta;
    if (heeded) here *= exp_negative(load_first(s.log_obs + n, count, kNeg) - shifts);
    mass += here;
    store(s.right + n, load(s.weight + n));
    store(s.weight + n, here);
  });
  const float overlap = sum(both);
  const Vec scale = splat(1 / overlap), rescale = splat(1 / sum(mass));
  if (!(overlap * seen.norm >= kOverlapFloor)) return false;
  sweep(N, [&](Index n, Index count) {
    Vec left = load_first(s.alpha + n, count, 0) * scale;
    store(s.left + n, left);
    store(s.weight + n, load(s.weight + n) * rescale);
    store_first(s.alpha + n, count, left * load(s.beta + n));
  });
  return true;
}

// One thread's workplace: it takes chunks of rows of a model one after the other.
class Worker {
 public:
  explicit Worker(const Problem& problem) : p_(problem), N_(problem.N), T_(problem.T) {
    vecs_ = (N_ + kWidth - 1) / kWidth;
    ld_ = (vecs_ | 1) * kWidth;  // an odd number of vectors: rows spread over all cache sets
    groups_.resize(p_.A);
    for (Group& g : groups_) g.from.resize(p_.chunk_rows), g.to.resize(p_.chunk_rows);
    trans_.resize(p_.A * N_ * ld_);
    init_.resize(ld_);
    for (Floats* f : {&now_, &weight_}) f->resize(p_.chunk_rows * ld_);
    observed_.resize(p_.chunk_rows * T_);
    arrival_.resize(p_.chunk_rows * T_);
    if (!p_.counted) return;
    for (Floats* f : {&back_, &counts_}) f->resize(p_.A * N_ * ld_);
    for (Floats* f : {&left_, &right_}) f->resize((p_.A + 1) * kBlock * ld_);  // the last counts nothing
    filled_.assign(p_.A, 0);
  }

  void filter(Index unit) {
    enter(unit);
    forward();
    for (Index lane = 0; lane < lanes_; ++lane) failed_[lane] ? exact_filter(lane) : write_norms(lane);
  }

  // Writes gamma and evidence; xi and initial of these rows go to `xi` [A, N, N] and `initial` [N].
  void smooth(Index unit, float* xi, float* initial) {
    enter(unit);
    do {
      counts_.clear();
      std::fill(filled_.begin(), filled_.end(), 0);
      std::fill(initial, initial + N_, 0.0f);
      forward();
    } while (!backward(initial));  // again without the rows whose underflow showed only now
    scale_counts(xi);
    for (Index lane = 0; lane < lanes_; ++lane)
      if (failed_[lane]) exact_smooth(lane, xi, initial);
  }

 private:
  void enter(Index unit) {
    model_ = p_.model(unit), first_row_ = p_.first_row(unit), lanes_ = p_.rows(unit);
    failed_.assign(lanes_, false);
    evidence_.assign(lanes_, {});
    for (Index lane = 0; lane < lanes_; ++lane)
      for (Index t = 0; t < T_; ++t) arrival_[t * lanes_ + lane] = p_.arrival(row(lane), t);
    std::memcpy(init_ + 0, p_.init + model_ * N_, N_ * sizeof(float));
    for (Index i = 0; i < p_.A * N_; ++i) std::memcpy(trans_ + i * ld_, trans(0) + i * N_, N_ * sizeof(float));
    if (!p_.counted) return;
    for (Index a = 0; a < p_.A; ++a)
      for (Index j = 0; j < N_; ++j) {
        float* to = back_ + (a * N_ + j) * ld_;
        for (Index i = 0; i < N_; ++i) to[i] = trans(a)[i * N_ + j];
      }
  }

  Index row(Index lane) const { return model_ * p_.B + first_row_ + lane; }
  const float* trans(Index a) const { return p_.trans + (model_ * p_.A + a) * N_ * N_; }
  const float* log_obs(Index lane, Index t) const { return p_.log_obs + (row(lane) * T_ + t) * N_; }
  float* belief(Index lane, Index t) const { return p_.belief + (row(lane) * T_ + t) * N_; }
  int32_t arrival(Index lane, Index t) const { return arrival_[t * lanes_ + lane]; }
  // The action that leads on from a step, or negative at a trial's last.
  int32_t departure(Index lane, Index t) const { return t + 1 < T_ ? arrival(lane, t + 1) : kPadding; }

  void multiply_groups(const Floats& matrices) {
    for (Index a = 0; a < p_.A; ++a) {
      Group& g = groups_[a];
      if (g.size == 0) continue;
      multiply(g.from.data(), 1, matrices + a * N_ * ld_, ld_, N_, g.to.data(), g.size, vecs_, false);
      g.size = 0;
    }
  }

  std::vector<Index> sound_lanes() const {
    std::vector<Index> lanes;
    for (Index lane = 0; lane < lanes_; ++lane)
      if (!failed_[lane]) lanes.push_back(lane);
    return lanes;
  }

  void forward() {
    const std::vector<Index> lanes = sound_lanes();
    std::fill(evidence_.begin(), evidence_.end(), Evidence{});
    for (Index t = 0; t < T_; ++t) {
      for (Index lane : lanes) {
        const int32_t how = arrival(lane, t);
        if (how >= 0) groups_[how].add(belief(lane, t - 1), now_ + lane * ld_);
        else if (how == kStart) std::memcpy(now_ + lane * ld_, init_ + 0, ld_ * sizeof(float));
      }
      multiply_groups(trans_);
      for (Index lane : lanes) {
        if (arrival(lane, t) == kPadding) {
          std::memset(belief(lane, t), 0, N_ * sizeof(float));
          continue;
        }
        fetch(log_obs(lane, std::min(t + 1, T_ - 1)), N_);
        fetch_to_write(belief(lane, std::min(t + 1, T_ - 1)), N_);
        Observed seen = observe(log_obs(lane, t), now_ + lane * ld_, belief(lane, t), N_);
        observed_[t * lanes_ + lane] = seen;
        if (!(seen.norm >= kOverlapFloor)) failed_[lane] = true;
        evidence_[lane].shift(seen.shift), evidence_[lane].norm(seen.norm);
      }
    }
  }

  void write_norms(Index lane) {
    for (Index t = 0; t < T_; ++t) {
      const Observed seen = observed_[t * lanes_ + lane];
      const float norm = seen.shift < kImpossible ? kNeg : std::log(seen.norm) + seen.shift;
      p_.log_norm[row(lane) * T_ + t] = arrival(lane, t) == kPadding ? 0 : norm;
    }
  }

  bool backward(float* initial) {
    const std::vector<Index> lanes = sound_lanes();
    bool fine = true;
    for (Index t = T_ - 1; t >= 0; --t) {
      for (Index lane : lanes) {
        const int32_t how = departure(lane, t);
        if (how >= 0) groups_[how].add(weight_ + lane * ld_, now_ + lane * ld_);
        else std::fill_n(now_ + lane * ld_, N_, 1.0f);
      }
      multiply_groups(back_);
      for (Index lane : lanes)
        if (arrival(lane, t) != kPadding && !step_back(lane, t, initial)) failed_[lane] = true, fine = false;
    }
    for (Index a = 0; a < p_.A; ++a) count_block(a);
    for (Index lane : lanes) p_.evidence[row(lane)] = evidence_[lane].total();
    return fine;
  }

  bool step_back(Index lane, Index t, float* initial) {
    const int32_t how = departure(lane, t);
    const Index block = how >= 0 ? how : p_.A, slot = (block * kBlock + (how >= 0 ? filled_[how] : 0)) * ld_;
    float* gamma = belief(lane, t);
    const Step step{log_obs(lane, t), now_ + lane * ld_, gamma, weight_ + lane * ld_, left_ + slot, right_ + slot};
    fetch(log_obs(lane, std::max<Index>(t - 1, 0)), N_);
    fetch(belief(lane, std::max<Index>(t - 1, 0)), N_);
    if (!combine(step, observed_[t * lanes_ + lane], N_)) return false;
    if (how >= 0 && ++filled_[how] == kBlock) count_block(how);
    if (arrival(lane, t) == kStart)
      for (Index n = 0; n < N_; ++n) initial[n] += gamma[n];
    return true;
  }

  // counts[a] += left^T right over the block.
  void count_block(Index a) {
    rows_from_.resize(N_), rows_to_.resize(N_);
    for (Index i = 0; i < N_; ++i) {
      rows_from_[i] = left_ + (a * kBlock * ld_ + i);
      rows_to_[i] = counts_ + (a * N_ + i) * ld_;
    }
    multiply(rows_from_.data(), ld_, right_ + a * kBlock * ld_, ld_, filled_[a], rows_to_.data(), N_, vecs_, true);
    filled_[a] = 0;
  }

  void scale_counts(float* xi) {
    for (Index i = 0; i < p_.A * N_; ++i) {
      const float *count = counts_ + i * ld_, *trans = trans_ + i * ld_;
      sweep(N_, [&](Index n, Index size) { store_first(xi + i * N_ + n, size, load(count + n) * load(trans + n)); });
    }
  }

  // In exact.h.
  struct Row;
  void exact_filter(Index lane);
  void exact_smooth(Index lane, float* xi, float* initial);

  const Problem& p_;
  const Index N_, T_;
  Index vecs_, ld_, model_ = 0, first_row_ = 0, lanes_ = 0;
  std::vector<Group> groups_;
  Floats trans_, back_, init_, now_, weight_, left_, right_, counts_;
  std::vector<Observed> observed_;  // [T, lanes], as is arrival
  std::vector<int32_t> arrival_;
  std::vector<Index> filled_;
  std::vector<char> failed_;
  std::vector<Evidence> evidence_;
  std::vector<const float*> rows_from_;
  std::vector<float*> rows_to_;
};

}  // namespace
