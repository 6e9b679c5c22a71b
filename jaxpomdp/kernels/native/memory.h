// A chain that may heed a memory: forward and backward over pairs of an active and a remembered state, rows of one
// model in step, and the expected uses of each table.
//
// What is remembered is let go at once, but for the few states K that are sometimes kept ("awake"): every other
// pair's past is just what was active a step before, and its future depends on the active state alone. So the N^2
// pairs are K columns, of those that remember an awake state, and one of all the rest: a step is K + 1 products of
// a vector and a matrix. The rest's column is the last.

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

constexpr Index kMemoryRows = 32, kMemoryBlock = 32;

// A batch of chains with a memory, of N states each.
struct MemoryProblem : Batch {
  Index N;
  const float *init, *trans, *lead, *heed, *note, *log_obs;
  float *evidence, *gamma, *held;

  // The most states that a model has ever kept.
  Index most_awake() const {
    Index most = 0;
    for (Index s = 0; s < S; ++s) {
      Index awake = 0;
      for (Index n = s * N; n < (s + 1) * N; ++n) awake += note[2 * n + 1] > 0;
      most = std::max(most, awake);
    }
    return most;
  }
};

// Where a unit's counts go, in the shapes of the tables; xi counts all moves, [A, N, N].
struct MemoryCounts {
  float *xi, *initial, *chain, *lead, *heed, *note;
};

// An awake state: how it is heeded (by chain, by memory) and let go (noted over, kept), and how often each was so.
struct Awake {
  Index state;
  float by[2], choice[2];
  double heeded[2], chosen[2];
};

// One thread's workplace: it takes chunks of rows of a model one after the other.
class MemoryWorker {
 public:
  explicit MemoryWorker(const MemoryProblem& problem) : p_(problem), N_(problem.N), T_(problem.T) {
    vecs_ = (N_ + kWidth - 1) / kWidth;
    ld_ = (vecs_ | 1) * kWidth;  // an odd number of vectors: rows spread over all cache sets
    for (Floats* f : {&own_, &own_back_, &any_, &any_back_, &any_counts_}) f->resize(p_.A * N_ * ld_);
    own_counts_.resize(p_.A * N_ * 2 * ld_);
    for (Floats* f : {&any_left_, &any_right_}) f->resize(p_.A * kMemoryBlock * ld_);
    seen_.resize(p_.chunk_rows * T_ * ld_);
    norm_.resize(p_.chunk_rows * T_);
    noted_.resize(ld_);
    any_filled_.resize(p_.A), own_filled_.resize(p_.A);
  }

  // Writes gamma, held and evidence; what is summed over these rows goes to `out`.
  void smooth(Index unit, const MemoryCounts& out) {
    enter(unit);
    do {
      clear(out);
      forward();
    } while (!backward(out));  // again without the rows whose underflow showed only now
    scale_counts(out);
    for (Index lane = 0; lane < lanes_; ++lane)
      if (failed_[lane]) exact_smooth(lane, out);
    count_notes(out);
  }

 private:
  Index row(Index lane) const { return first_row_ + lane; }
  Index at(Index lane, Index t) const { return (row(lane) * T_ + t) * N_; }
  const float* log_obs(Index lane, Index t) const { return p_.log_obs + at(lane, t); }
  float* gamma(Index lane, Index t) const { return p_.gamma + at(lane, t); }
  float* held(Index lane, Index t) const { return p_.held + at(lane, t); }
  const float* trans(Index a) const { return p_.trans + (model_ * p_.A + a) * N_ * N_; }
  const float* lead(Index a, Index state) const { return p_.lead + ((model_ * p_.A + a) * N_ + state) * N_; }
  const float* heed(Index state) const { return p_.heed + (model_ * N_ + state) * 2; }
  const float* note(Index state) const { return p_.note + (model_ * N_ + state) * 2; }
  bool sleeps(Index state) const { return !(note(state)[1] > 0); }
  int32_t arrival(Index lane, Index t) const { return p_.arrival(row(lane), t); }
  // The action that leads on from a step, or negative at a trial's last.
  int32_t departure(Index lane, Index t) const { return t + 1 < T_ ? arrival(lane, t + 1) : kPadding; }

  float* belief(Index lane, Index t) { return belief_ + (t * lanes_ + lane) * size_; }
  float* seen(Index lane, Index t) { return seen_ + (t * lanes_ + lane) * ld_; }
  float* pairs(Index lane) { return pairs_ + lane * size_; }
  float* now(Index lane) { return now_ + lane * size_; }
  float* future(Index lane) { return future_ + lane * size_; }
  const float* led(Index a, Index k) const { return led_ + (a * awake_.size() + k) * ld_; }
  Index rest() const { return awake_.size() * ld_; }  // where the column of all that is not awake begins

  // Calls f(n) for each vector of a column.
  template <class F>
  void each(F f) const {
    for (Index n = 0, end = vecs_ * kWidth; n < end; n += kWidth) f(n);
  }
  float dot(const float* x, const float* y) const {
    Vec total{};
    each([&](Index n) { total += load(x + n) * load(y + n); });
    return sum(total);
  }
  float mass(const float* x) const {
    Vec total{};
    each([&](Index n) { total += load(x + n); });
    return sum(total);
  }

  void enter(Index unit) {
    lanes_ = p_.rows(unit), first_row_ = p_.first_row(unit) + p_.model(unit) * p_.B;
    failed_.assign(lanes_, false);
    evidence_.assign(lanes_, {});
    if (model_ == p_.model(unit)) return;
    model_ = p_.model(unit);
    wake();
    for (Index a = 0; a < p_.A; ++a)
      for (Index i = 0; i < N_; ++i) {
        const float *moves = trans(a) + i * N_, *told = lead(a, i);
        for (Index j = 0, to = (a * N_ + i) * ld_; j < N_; ++j) {
          const Index back = (a * N_ + j) * ld_ + i;
          *(own_ + (to + j)) = *(own_back_ + back) = moves[j];
          *(any_ + (to + j)) = *(any_back_ + back) = heed(i)[0] * moves[j] + heed(i)[1] * told[j];
        }
      }
    for (Index a = 0; a < p_.A; ++a)
      for (size_t k = 0; k < awake_.size(); ++k)
        for (Index j = 0; j < N_; ++j)
          *(led_ + ((a * awake_.size() + k) * ld_ + j)) = awake_[k].by[1] * lead(a, awake_[k].state)[j];
  }

  // Find who is awake, make room for so many columns, and prepare a trial's start: its first state is remembered.
  void wake() {
    awake_.clear();
    for (Index n = 0; n < N_; ++n)
      if (!sleeps(n)) awake_.push_back({n, {heed(n)[0], heed(n)[1]}, {note(n)[0], note(n)[1]}, {}, {}});
    make_room(awake_.size());
    const float* init = p_.init + model_ * N_;
    start_.clear();
    std::copy_n(init, N_, start_ + rest());
    for (size_t k = 0; k < awake_.size(); ++k) {
      const Index state = awake_[k].state;
      *(start_ + (k * ld_ + state)) = init[state], *(start_ + (rest() + state)) = 0;
    }
  }
  void make_room(Index columns) {
    if (size_ == (columns + 1) * ld_) return;
    size_ = (columns + 1) * ld_;
    belief_.resize(p_.chunk_rows * T_ * size_);
    for (Floats* f : {&pairs_, &now_, &future_}) f->resize(p_.chunk_rows * size_);
    start_.resize(size_);
    for (Floats* f : {&led_, &lead_counts_}) f->resize(p_.A * columns * ld_);
    own_room_ = kMemoryBlock + columns;
    own_left_.resize(p_.A * own_room_ * ld_), own_right_.resize(p_.A * own_room_ * 2 * ld_);
    any_groups_.assign(p_.A, group(p_.chunk_rows)), own_groups_.assign(p_.A, group(p_.chunk_rows * columns));
    told_.resize(columns);
  }
  static Group group(Index rows) { return {std::vector<const float*>(rows), std::vector<float*>(rows)}; }

  void clear(const MemoryCounts& out) {
    for (Floats* f : {&any_counts_, &own_counts_, &lead_counts_}) f->clear();
    std::fill(any_filled_.begin(), any_filled_.end(), 0), std::fill(own_filled_.begin(), own_filled_.end(), 0);
    std::fill_n(out.initial, N_, 0.0f);
    for (Awake& k : awake_) k.heeded[0] = k.heeded[1] = k.chosen[0] = k.chosen[1] = 0;
  }

  std::vector<Index> sound_lanes() const {
    std::vector<Index> lanes;
    for (Index lane = 0; lane < lanes_; ++lane)
      if (!failed_[lane]) lanes.push_back(lane);
    return lanes;
  }

  // The memory notes the active state or keeps its own: what sleeps is let go, and an awake state that is noted
  // joins those that remember it.
  void remember(const float* belief, float* pairs) const {
    float* noted = pairs + rest();
    std::memcpy(noted, belief + rest(), ld_ * sizeof(float));
    for (size_t k = 0; k < awake_.size(); ++k) {
      const float *share = belief + k * ld_, note = awake_[k].choice[0], keep = awake_[k].choice[1];
      float* kept = pairs + k * ld_;
      each([&](Index n) {
        store(noted + n, load(noted + n) + load(share + n) * note);
        store(kept + n, load(share + n) * keep);
      });
    }
    for (size_t k = 0; k < awake_.size(); ++k) {
      const Index state = awake_[k].state;
      pairs[k * ld_ + state] += noted[state], noted[state] = 0;
    }
  }

  void queue(Index a, const float* from, float* to) {
    for (size_t k = 0; k < awake_.size(); ++k) own_groups_[a].add(from + k * ld_, to + k * ld_);
    any_groups_[a].add(from + rest(), to + rest());
  }

  void multiply_groups(const Floats& own, const Floats& any) {
    for (Index a = 0; a < p_.A; ++a) {
      multiply_group(own_groups_[a], own + a * N_ * ld_);
      multiply_group(any_groups_[a], any + a * N_ * ld_);
    }
  }
  void multiply_group(Group& g, const float* matrix) {
    multiply(g.from.data(), 1, matrix, ld_, N_, g.to.data(), g.size, vecs_, false);
    g.size = 0;
  }

  void forward() {
    const std::vector<Index> lanes = sound_lanes();
    std::fill(evidence_.begin(), evidence_.end(), Evidence{});
    for (Index t = 0; t < T_; ++t) {
      for (Index lane : lanes)
        if (const int32_t how = arrival(lane, t); how >= 0) {
          remember(belief(lane, t - 1), pairs(lane));
          queue(how, pairs(lane), now(lane));
        }
      multiply_groups(own_, any_);
      for (Index lane : lanes) {
        const int32_t how = arrival(lane, t);
        if (how == kPadding) continue;
        fetch(log_obs(lane, std::min(t + 1, T_ - 1)), N_);
        if (how >= 0) heed_memory(how, pairs(lane), now(lane));
        const float shift = observe(how >= 0 ? now(lane) : start_ + 0, lane, t), norm = norm_[lane * T_ + t];
        if (!(norm >= kOverlapFloor)) failed_[lane] = true;
        evidence_[lane].shift(shift), evidence_[lane].norm(norm);
      }
    }
  }

  // Of those that remember an awake state, some moved by the chain, and some by that state's row.
  void heed_memory(Index a, const float* pairs, float* now) const {
    for (size_t k = 0; k < awake_.size(); ++k, pairs += ld_, now += ld_) {
      const float by_chain = awake_[k].by[0], all = mass(pairs);
      const float* told = led(a, k);
      each([&](Index n) { store(now + n, load(now + n) * by_chain + load(told + n) * all); });
    }
  }

  // belief ∝ now * density; an observation that no state allows is ignored. Returns its largest log-density.
  float observe(const float* now, Index lane, Index t) {
    float *density = seen(lane, t), *to = belief(lane, t);
    const float shift = relative(log_obs(lane, t), density, N_);
    if (shift < kImpossible) std::fill_n(density, N_, 1.0f);
    const Index size = size_, ld = ld_;
    Vec total{};
    each([&](Index n) {
      const Vec here = load(density + n);
      for (Index at = n; at < size; at += ld) {
        const Vec joint = load(now + at) * here;
        total += joint;
        store(to + at, joint);
      }
    });
    const float norm = norm_[lane * T_ + t] = sum(total);
    scale(to, 1 / norm);
    return shift;
  }
  void scale(float* columns, float by) const {
    for (float* end = columns + size_; columns < end; columns += ld_)
      each([&](Index n) { store(columns + n, load(columns + n) * by); });
  }

  bool backward(const MemoryCounts& out) {
    const std::vector<Index> lanes = sound_lanes();
    bool fine = true;
    for (Index t = T_ - 1; t >= 0; --t) {
      for (Index lane : lanes)
        if (const int32_t how = departure(lane, t); how >= 0) queue(how, future(lane), now(lane));
      multiply_groups(own_back_, any_back_);
      for (Index lane : lanes)
        if (!step_back(lane, t, out)) failed_[lane] = true, fine = false;
    }
    for (Index a = 0; a < p_.A; ++a) count_any(a), count_own(a);
    for (Index lane : lanes) p_.evidence[row(lane)] = evidence_[lane].total();
    return fine;
  }

  // False: not trusted.
  bool step_back(Index lane, Index t, const MemoryCounts& out) {
    const int32_t how = arrival(lane, t), next = departure(lane, t);
    std::fill_n(held(lane, t), N_, 0.0f);
    if (how == kPadding) {
      std::fill_n(gamma(lane, t), N_, 0.0f);
      return true;
    }
    fetch_to_write(gamma(lane, std::max<Index>(t - 1, 0)), N_);
    fetch_to_write(held(lane, std::max<Index>(t - 1, 0)), N_);
    float overlap = 1;
    if (next >= 0) remember(belief(lane, t), pairs(lane)), overlap = look_ahead(next, lane, t);
    else std::fill_n(now(lane), size_, 1.0f);
    if (!(overlap * norm_[lane * T_ + t] >= kOverlapFloor)) return false;
    if (next >= 0) count(next, lane, t, 1 / overlap);
    combine(lane, t, 1 / overlap);
    if (how == kStart) begin(lane, t, 1 / overlap, out);
    return true;
  }

  // A trial's first state is remembered.
  void begin(Index lane, Index t, float share, const MemoryCounts& out) {
    const float *past = belief(lane, t) + rest(), *beta = now(lane) + rest();
    for (Index n = 0; n < N_; ++n) {
      held(lane, t)[n] += past[n] * beta[n] * share;
      out.initial[n] += gamma(lane, t)[n];
    }
  }

  // What an awake state's choices came to at a step.
  struct Told {
    float all, heeded[2], chosen[2];
  };

  // Turns the products of the future with the chain's own moves, for the rest with any, into what is to come
  // after each pair at this step; returns its overlap with belief.
  float look_ahead(Index a, Index lane, Index t) {
    const float *past = belief(lane, t), *pair = pairs(lane), *arriving = future(lane);
    float *beta = now(lane), *same = beta + rest();  // after the active state was noted
    for (size_t k = 0; k < awake_.size(); ++k) {
      const Index state = awake_[k].state;
      told_[k].heeded[1] = dot(led(a, k), arriving + k * ld_);
      same[state] = awake_[k].by[0] * beta[k * ld_ + state] + told_[k].heeded[1];
    }
    float overlap = dot(past + rest(), same);
    for (size_t k = 0; k < awake_.size(); ++k, past += ld_, pair += ld_, beta += ld_) {
      const Awake node = awake_[k];  // a local copy, which stores cannot touch
      const float told = told_[k].heeded[1];
      Vec all{}, own{}, noted{}, kept{};
      each([&](Index n) {
        const Vec by_chain = load(beta + n) * node.by[0], ahead = by_chain + told;
        const Vec if_noted = load(same + n) * node.choice[0], if_kept = ahead * node.choice[1];
        all += load(pair + n), own += load(pair + n) * by_chain;
        noted += load(past + n) * if_noted, kept += load(past + n) * if_kept;
        store(beta + n, if_noted + if_kept);
      });
      const float total = sum(all);
      told_[k] = {total, {sum(own), total * told}, {sum(noted), sum(kept)}};
      overlap += told_[k].chosen[0] + told_[k].chosen[1];
    }
    return overlap;
  }

  // Counts of a step, some without the probability of the move: the left sides are what was before it, the right
  // sides what came; and what slept and was remembered after this step.
  void count(Index a, Index lane, Index t, float share) {
    const float *pair = pairs(lane), *arriving = future(lane), *same = now(lane) + rest();
    for (size_t k = 0; k < awake_.size(); ++k, pair += ld_, arriving += ld_) {
      const Index slot = a * own_room_ + own_filled_[a]++;
      float *left = own_left_ + slot * ld_, *right = own_right_ + slot * 2 * ld_, *right_too = right + ld_;
      float* sum = lead_counts_ + (a * awake_.size() + k) * ld_;
      const float *told = led(a, k), by_chain = awake_[k].by[0], all = told_[k].all * share;
      each([&](Index n) {
        const Vec came = load(arriving + n), by_memory = came * load(told + n);
        store(left + n, load(pair + n) * share);
        store(right + n, came * by_chain), store(right_too + n, by_memory);
        store(sum + n, load(sum + n) + by_memory * all);
      });
      for (int i = 0; i < 2; ++i) {
        awake_[k].heeded[i] += told_[k].heeded[i] * share;
        awake_[k].chosen[i] += told_[k].chosen[i] * share;
      }
    }
    const Index slot = (a * kMemoryBlock + any_filled_[a]++) * ld_;
    float *left = any_left_ + slot, *right = any_right_ + slot, *remembered = held(lane, t + 1);
    sweep(N_, [&](Index n, Index size) {
      const Vec noted = load(pair + n) * share;
      store(left + n, noted), store(right + n, load(arriving + n));
      store_first(remembered + n, size, load_first(remembered + n, size, 0) + noted * load(same + n));
    });
    if (any_filled_[a] == kMemoryBlock) count_any(a);
    if (own_filled_[a] >= kMemoryBlock) count_own(a);
  }

  // gamma, and who of the awake is remembered; future ∝ density * beta.
  void combine(Index lane, Index t, float share) {
    const float *past = belief(lane, t), *beta = now(lane), *density = seen(lane, t);
    float *to = future(lane), *both_of = gamma(lane, t);
    const Index size = size_, ld = ld_;
    Vec total{};
    sweep(N_, [&](Index n, Index count) {
      const Vec here = load(density + n);
      Vec both{};
      for (Index at = n; at < size; at += ld) {
        const Vec later = load(beta + at), onward = later * here;
        both += load(past + at) * later, total += onward;
        store(to + at, onward);
      }
      store_first(both_of + n, count, both * share);
    });
    scale(to, 1 / sum(total));
    for (size_t k = 0; k < awake_.size(); ++k)
      held(lane, t)[awake_[k].state] = dot(past + k * ld_, beta + k * ld_) * share;
  }

  // counts[a] += left^T right over the block, for moves that what slept before may have made.
  void count_any(Index a) {
    count_block(any_left_ + a * kMemoryBlock * ld_, any_right_ + a * kMemoryBlock * ld_, any_filled_[a],
                any_counts_ + a * N_ * ld_, ld_);
  }
  // The same for moves while an awake state is remembered: by the chain and by the memory, side by side.
  void count_own(Index a) {
    count_block(own_left_ + a * own_room_ * ld_, own_right_ + a * own_room_ * 2 * ld_, own_filled_[a],
                own_counts_ + a * N_ * 2 * ld_, 2 * ld_);
  }
  void count_block(const float* left, const float* right, Index& filled, float* counts, Index width) {
    rows_from_.resize(N_), rows_to_.resize(N_);
    for (Index i = 0; i < N_; ++i) rows_from_[i] = left + i, rows_to_[i] = counts + i * width;
    multiply(rows_from_.data(), ld_, right, width, filled, rows_to_.data(), N_, width / kWidth, true);
    filled = 0;
  }

  void scale_counts(const MemoryCounts& out) {
    std::fill_n(out.heed, 2 * N_, 0.0f), std::fill_n(out.note, 2 * N_, 0.0f);
    for (Index a = 0, i = 0; a < p_.A; ++a)
      for (Index state = 0; state < N_; ++state, ++i) scale_row(a, state, i, out);
    for (size_t k = 0; k < awake_.size(); ++k) {
      const Awake& node = awake_[k];
      for (int i = 0; i < 2; ++i)
        out.heed[2 * node.state + i] = node.heeded[i], out.note[2 * node.state + i] = node.chosen[i];
      for (Index a = 0; a < p_.A; ++a)
        std::copy_n(lead_counts_ + (a * awake_.size() + k) * ld_, N_, out.lead + (a * N_ + node.state) * N_);
    }
  }
  void scale_row(Index a, Index state, Index i, const MemoryCounts& out) {
    const float *own = own_counts_ + i * 2 * ld_, *led = own + ld_, *any = any_counts_ + i * ld_;
    const float *moves = own_ + i * ld_, *told = lead(a, state), by[] = {heed(state)[0], heed(state)[1]};
    float *chain = out.chain + i * N_, *lead = out.lead + i * N_, *xi = out.xi + i * N_;
    Vec heeded[2] = {};
    sweep(N_, [&](Index n, Index size) {
      const Vec step = load(moves + n), count = load(any + n);
      const Vec by_chain = step * count * by[0], by_memory = load_first(told + n, size, 0) * count * by[1];
      const Vec all = step * load(own + n) + by_chain;
      heeded[0] += by_chain, heeded[1] += by_memory;
      store_first(chain + n, size, all), store_first(lead + n, size, by_memory);
      store_first(xi + n, size, all + load(led + n) + by_memory);
    });
    for (int c = 0; c < 2; ++c) out.heed[2 * state + c] += sum(heeded[c]);
  }

  // What sleeps and is remembered is let go at the next step.
  void count_notes(const MemoryCounts& out) {
    noted_.clear();
    for (Index lane = 0; lane < lanes_; ++lane)
      for (Index t = 0; t < T_; ++t) {
        if (departure(lane, t) < 0) continue;
        const float* remembered = held(lane, t);
        float* noted = noted_ + 0;
        sweep(N_, [&](Index n, Index size) {
          store(noted + n, load(noted + n) + load_first(remembered + n, size, 0));
        });
      }
    for (Index n = 0; n < N_; ++n)
      if (sleeps(n)) out.note[2 * n] = *(noted_ + n);
  }

  // In memory_exact.h.
  struct Tape;
  void exact_smooth(Index lane, const MemoryCounts& out);

  const MemoryProblem& p_;
  const Index N_, T_;
  Index vecs_, ld_, size_ = 0, own_room_ = 0, model_ = -1, first_row_ = 0, lanes_ = 0;
  std::vector<Awake> awake_;
  std::vector<Told> told_;
  // Moves by the chain, and by whichever a state that has just been noted heeds, and back: [A, N, ld].
  Floats own_, own_back_, any_, any_back_;
  Floats led_, lead_counts_;               // moves by the memory, [A, K, ld]
  Floats start_;                           // columns of pairs: [K + 1, ld]
  Floats belief_, pairs_, now_, future_;   // [T, rows, K + 1, ld]; [rows, K + 1, ld]
  Floats seen_;                            // densities, [T, rows, ld]
  Floats noted_;                           // [ld]
  Floats any_left_, any_right_, any_counts_, own_left_, own_right_, own_counts_;
  std::vector<float> norm_;
  std::vector<Group> any_groups_, own_groups_;
  std::vector<Index> any_filled_, own_filled_;
  std::vector<char> failed_;
  std::vector<Evidence> evidence_;
  std::vector<const float*> rows_from_;
  std::vector<float*> rows_to_;
};

}  // namespace
