// The online phase: agents that act in tabular worlds, keep beliefs and learn values, each on its own.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "threads.h"
#include "vectors.h"

namespace {

// Agents s < S, world states x < X with K outcomes, actions a < A, symbols o < O, memory states n < N.
struct Acting {
  Index S, models, N, A, O, X, K, trials, limit, noted;  // `models` is S or 1; `noted` is rows of each log
  const float *init, *trans, *log_obs;                   // [models, N], [models, A, N, N], [models, O, N]
  const float* q;                                        // [S, N, A]
  const float *draws, *level;                            // [S, trials + 1, limit + 1, 6], [S, trials * limit + 1]
  const int32_t* successors;                             // [A, X, K]
  const float *transition_cdf, *reward, *observation_cdf, *first_cdf, *start_cdf;
  const bool* terminal;
  float reward_noise;
  bool seen_by_action;
  const float* settings;  // rate, discount, lambda, chance of repeating
  bool replacing, greedy_rule, boltzmann;
  float* learnt;  // [S, N, A], as q
  int32_t* steps;
  int32_t *observation, *action, *arrived;  // the log, each [S, trials * limit], as the next ones
  float *paid, *best;
  bool *active, *ended, *terminated;
};

constexpr Index kDraws = 6, kWorldDraws = 3;

class Player {
 public:
  explicit Player(const Acting& acting) : w_(acting), N_(acting.N) {
    ld_ = (N_ + kWidth - 1) / kWidth * kWidth;
    trans_.resize(w_.A * N_ * ld_), log_obs_.resize(w_.O * ld_), init_.resize(ld_);
    q_.resize(w_.A * ld_), trace_.resize(w_.A * ld_);
    for (Floats* f : {&belief_, &next_, &predicted_}) f->resize(ld_);
    values_.resize(w_.A), cdf_.resize(w_.A), traced_.resize(w_.A);
  }

  void play(Index s) {
    take_model(w_.models == 1 ? 0 : s);
    for (Index n = 0; n < N_; ++n)
      for (Index a = 0; a < w_.A; ++a) *(q_ + a * ld_ + n) = w_.q[(s * N_ + n) * w_.A + a];
    seed_ = s, step_ = 0;
    for (Index trial = 0; trial < w_.trials; ++trial) play_trial(trial);
    for (Index n = 0; n < N_; ++n)
      for (Index a = 0; a < w_.A; ++a) w_.learnt[(s * N_ + n) * w_.A + a] = *(q_ + a * ld_ + n);
    w_.steps[s] = step_;
  }

 private:
  // Rows padded to whole vectors: a state beyond the last is impossible.
  void take_model(Index model) {
    if (model == model_) return;
    model_ = model;
    const float *trans = w_.trans + model * w_.A * N_ * N_, *log_obs = w_.log_obs + model * w_.O * N_;
    for (Index row = 0; row < w_.A * N_; ++row) std::memcpy(trans_ + row * ld_, trans + row * N_, N_ * sizeof(float));
    for (Index o = 0; o < w_.O; ++o) {
      std::fill_n(log_obs_ + o * ld_, ld_, kNeg);
      std::memcpy(log_obs_ + o * ld_, log_obs + o * N_, N_ * sizeof(float));
    }
    std::memcpy(init_ + 0, w_.init + model * N_, N_ * sizeof(float));
  }

  void play_trial(Index trial) {
    const float* draws = w_.draws + (seed_ * (w_.trials + 1) + trial) * (w_.limit + 1) * kDraws;
    Index state = draw(w_.start_cdf, w_.X, draws[0]);
    Index seen = draw(w_.first_cdf + state * w_.O, w_.O, draws[1]);
    observe(init_ + 0, seen, belief_ + 0);
    for (Index a = 0; a < w_.A; ++a) values_[a] = value(a, belief_ + 0), traced_[a] = false;
    choose(-1, draws + kWorldDraws);
    bool over = false;
    for (Index t = 0; !over; ++t) {
      draws += kDraws;
      const Index did = chosen_, at = did * w_.X + state, row = seed_ * w_.noted + step_;
      const bool explored = explored_;
      const Index outcome = std::min(draw(w_.transition_cdf + at * w_.K, w_.K, draws[0]), w_.K - 1);
      const Index to = w_.successors[at * w_.K + outcome];
      const Index view = (w_.seen_by_action ? did * w_.X : 0) + to;
      const Index sees = draw(w_.observation_cdf + view * w_.O, w_.O, draws[1]);
      const float noise = w_.terminal[state] ? 0 : w_.reward_noise * (2 * draws[2] - 1);
      const float reward = w_.reward[at * w_.K + outcome] + noise;
      const bool died = w_.terminal[to];
      over = died || t + 1 >= w_.limit;
      ++step_;
      const float best = learn(did, explored, sees, reward, died, over, draws + kWorldDraws);
      w_.observation[row] = seen, w_.action[row] = did, w_.paid[row] = reward, w_.arrived[row] = sees;
      w_.active[row] = true, w_.ended[row] = over, w_.terminated[row] = died, w_.best[row] = best;
      state = to, seen = sees;
    }
  }

  // One step of SARSA(lambda) or Q(lambda) on beliefs, and the next choice; returns the best value there.
  float learn(Index did, bool explored, Index sees, float reward, bool died, bool over, const float* draws) {
    const float rate = w_.settings[0], discount = w_.settings[1], fade = discount * w_.settings[2];
    propagate(did);
    observe(predicted_ + 0, sees, next_ + 0);
    const float before = value(did, belief_ + 0);
    for (Index a = 0; a < w_.A; ++a) values_[a] = value(a, next_ + 0);
    const float best = died ? 0 : *std::max_element(values_.begin(), values_.end());
    choose(did, draws);
    const float following = over || w_.greedy_rule ? best : values_[chosen_];
    const float delta = reward + discount * following - before;
    if (rate != 0) {
      mark(did, w_.greedy_rule && explored ? 0 : fade);
      for (Index a = 0; a < w_.A; ++a)
        if (traced_[a]) add(q_ + a * ld_, trace_ + a * ld_, rate * delta);
    }
    std::swap(belief_, next_);
    return best;
  }

  static Index draw(const float* cdf, Index count, float uniform) {
    Index found = 0;
    for (Index k = 0; k < count; ++k) found += uniform >= cdf[k];
    return found;
  }

  // Exploring or not, by the level of the step: an action from `values_`, `chosen_`.
  void choose(Index last, const float* draws) {
    const float level = w_.level[seed_ * (w_.noted + 1) + step_];
    const Index greedy = std::max_element(values_.begin(), values_.end()) - values_.begin();
    if (w_.boltzmann) {
      chosen_ = soft(std::max(level, 1e-8f), values_[greedy], draws[1]);
      explored_ = chosen_ != greedy;
      return;
    }
    explored_ = draws[0] < level;
    const Index anywhere = std::min<Index>(draws[1] * w_.A, w_.A - 1);
    const bool again = explored_ && draws[2] < w_.settings[3] && last >= 0;
    chosen_ = again ? last : explored_ ? anywhere : greedy;
  }

  Index soft(float temperature, float most, float uniform) {
    float total = 0;
    for (Index a = 0; a < w_.A; ++a) cdf_[a] = std::exp((values_[a] - most) / temperature), total += cdf_[a];
    float so_far = 0;
    for (Index a = 0; a < w_.A; ++a) cdf_[a] = so_far += cdf_[a] / total;
    return std::min(draw(cdf_.data(), w_.A, uniform), w_.A - 1);
  }

  // predicted(j) = sum_i belief(i) trans(a, i, j), eight vectors of columns at a time.
  void propagate(Index a) {
    for (Index from = 0; from < ld_; from += 8 * kWidth) {
      const Index vecs = std::min<Index>(8, (ld_ - from) / kWidth);
      Vec total[8] = {};
      for (Index i = 0; i < N_; ++i) {
        const float b = *(belief_ + i);
        if (b == 0) continue;
        const float* row = trans_ + (a * N_ + i) * ld_ + from;
        for (Index v = 0; v < vecs; ++v) total[v] += load(row + v * kWidth) * b;
      }
      for (Index v = 0; v < vecs; ++v) store(predicted_ + from + v * kWidth, total[v]);
    }
  }

  // belief(i) ~ predicted(i) exp(log_obs(i)); an impossible observation changes nothing.
  void observe(const float* predicted, Index sees, float* belief) {
    const float* log_obs = log_obs_ + sees * ld_;
    Vec most = splat(kNeg);
    for (Index n = 0; n < ld_; n += kWidth) {
      const Vec reached = load(predicted + n);
      most = larger(most, reached > splat(0) ? load(log_obs + n) : splat(kNeg));
    }
    const float shift = peak(most);
    if (shift <= kImpossible) return (void)std::memcpy(belief, predicted, ld_ * sizeof(float));
    Vec total{};
    for (Index n = 0; n < ld_; n += kWidth) {
      const Vec reached = load(predicted + n), gap = load(log_obs + n) - splat(shift);
      const Vec joint = reached > splat(0) ? reached * exp_negative(gap) : Vec{};
      store(belief + n, joint), total += joint;
    }
    const float mass = sum(total);
    if (mass < 1e-30f) return observe_in_logs(predicted, log_obs, belief);
    for (Index n = 0; n < ld_; n += kWidth) store(belief + n, load(belief + n) / mass);
  }

  // The same where products underflow.
  void observe_in_logs(const float* predicted, const float* log_obs, float* belief) {
    double most = kNeg, total = 0;
    const auto joint = [&](Index n) { return predicted[n] > 0 ? std::log(double(predicted[n])) + log_obs[n] : kNeg; };
    for (Index n = 0; n < N_; ++n) most = std::max(most, joint(n));
    for (Index n = 0; n < N_; ++n) total += belief[n] = std::exp(joint(n) - most);
    for (Index n = 0; n < N_; ++n) belief[n] /= total;
  }

  float value(Index a, const float* belief) const {
    const float* q = q_ + a * ld_;
    Vec total{};
    for (Index n = 0; n < ld_; n += kWidth) total += load(belief + n) * load(q + n);
    return sum(total);
  }

  // trace := fade trace + belief [a = did]; an action not yet taken in the trial has no trace.
  void mark(Index did, float fade) {
    for (Index a = 0; a < w_.A; ++a)
      if (traced_[a] && a != did)
        for (Index n = 0; n < ld_; n += kWidth) store(trace_ + a * ld_ + n, load(trace_ + a * ld_ + n) * fade);
    float* trace = trace_ + did * ld_;
    const float kept = traced_[did] ? fade : 0;
    for (Index n = 0; n < ld_; n += kWidth) {
      const Vec old = load(trace + n) * kept, now = load(belief_ + n);
      store(trace + n, w_.replacing ? larger(old, now) : old + now);
    }
    traced_[did] = true;
  }

  void add(float* x, const float* y, float by) const {
    for (Index n = 0; n < ld_; n += kWidth) store(x + n, load(x + n) + load(y + n) * by);
  }

  const Acting& w_;
  const Index N_;
  Index ld_, model_ = -1, seed_ = 0, step_ = 0, chosen_ = 0;
  bool explored_ = false;
  Floats trans_, log_obs_, init_, q_, trace_, belief_, next_, predicted_;
  std::vector<float> values_, cdf_;
  std::vector<char> traced_;
};

}  // namespace
