// Expected counts, filtering, acting and SARSA replay on the CPU, behind JAX's foreign function interface.
//
// Rows of one model run in step: at each time the rows that took the same action share one small matrix
// product, and the expected transitions are one product per action over blocks of steps. Probabilities are
// renormalised at every step; a row where underflow mattered is done again in logarithms and double precision.
// The semantics are those of kernels/smoothing.py, kernels/filtering.py and agents/trial.py, the tests' oracles.

#include <algorithm>
#include <cstdint>
#include <memory>
#include <new>
#include <vector>

#include "act.h"
#include "exact.h"
#include "replay.h"
#include "tapes.h"
#include "threads.h"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;

// The arrays of a call. Python has checked their shapes and dtypes, so that one binding serves all kernels,
// which compiles in half the time.
struct Call {
  ffi::RemainingArgs args;
  ffi::RemainingRets rets;

  ffi::AnyBuffer in(size_t i) const { return *args.get<ffi::AnyBuffer>(i); }
  ffi::AnyBuffer out(size_t i) const { return **rets.get<ffi::AnyBuffer>(i); }
  const float* floats(size_t i) const { return static_cast<const float*>(in(i).untyped_data()); }
  const int32_t* ints(size_t i) const { return static_cast<const int32_t*>(in(i).untyped_data()); }
  const bool* flags(size_t i) const { return static_cast<const bool*>(in(i).untyped_data()); }
  template <class T = float>
  T* result(size_t i) const { return static_cast<T*>(out(i).untyped_data()); }
};

ffi::Error done(bool fine) { return fine ? ffi::Error::Success() : ffi::Error::Internal("jaxpomdp: out of memory"); }

// Threads that pay: each takes some 20 microseconds to start, in which one does about 3e5 multiplications.
Index useful_threads(double multiplications) { return std::clamp<Index>(multiplications / 3e5, 1, thread_count()); }

// init, trans, log_obs, actions, start, valid; leading axes beyond these, as vmap makes them, are more models.
Problem problem_of(const Call& call, bool counted) {
  const auto shape = call.in(2).dimensions(), square = call.in(1).dimensions();
  const size_t rank = shape.size();
  Problem p{};
  p.B = shape[rank - 3], p.T = shape[rank - 2], p.N = shape[rank - 1];
  p.A = square[square.size() - 3];
  p.S = p.N == 0 ? 0 : call.in(0).element_count() / p.N;
  p.init = call.floats(0), p.trans = call.floats(1), p.log_obs = call.floats(2);
  p.actions = call.ints(3), p.start = call.flags(4), p.valid = call.flags(5);
  p.counted = counted;
  p.plan_chunks();
  return p;
}

double multiplications(const Problem& p) { return 3.0 * p.S * p.B * p.T * (p.N + 32) * p.N; }

// Results: belief, log_norm.
ffi::Error filter_tapes(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary) {
  const Call call{args, rets};
  Problem p = problem_of(call, false);
  p.belief = call.result(0), p.log_norm = call.result(1);
  prefer_large_pages(p.belief, call.out(0).element_count());
  return done(parallel(p.S * p.chunks, useful_threads(multiplications(p)), [&] {
    return [worker = std::make_shared<Worker>(p)](Index unit) { worker->filter(unit); };
  }));
}

// Adds the parts of each model's counts, in their order.
void merge(const std::vector<float>& parts, Index models, Index chunks, Index size, float* out) {
  const float* part = parts.data();
  for (Index s = 0; s < models; ++s, out += size) {
    std::fill_n(out, size, 0.0f);
    for (Index chunk = 0; chunk < chunks; ++chunk, part += size)
      for (Index i = 0; i < size; ++i) out[i] += part[i];
  }
}

// Results: evidence, gamma, xi, initial.
ffi::Error estep(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary) {
  const Call call{args, rets};
  Problem p = problem_of(call, true);
  p.evidence = call.result(0), p.belief = call.result(1);
  prefer_large_pages(p.belief, call.out(1).element_count());
  const Index cube = p.A * p.N * p.N, units = p.S * p.chunks;
  std::vector<float> xis, initials;
  float *xi = call.result(2), *initial = call.result(3), *xi_to = xi, *initial_to = initial;
  try {
    if (p.chunks > 1) xis.resize(units * cube), initials.resize(units * p.N);
  } catch (const std::bad_alloc&) {
    return done(false);
  }
  if (p.chunks > 1) xi_to = xis.data(), initial_to = initials.data();
  const bool fine = parallel(units, useful_threads(multiplications(p)), [&] {
    return [=, worker = std::make_shared<Worker>(p)](Index unit) {
      worker->smooth(unit, xi_to + unit * cube, initial_to + unit * p.N);
    };
  });
  if (p.chunks > 1) merge(xis, p.S, p.chunks, cube, xi);
  if (p.chunks > 1) merge(initials, p.S, p.chunks, p.N, initial);
  return done(fine);
}

// q, beliefs, actions, rewards, start, valid, terminated, settings; result: the new q.
ffi::Error replay(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary choices) {
  const Call call{args, rets};
  const auto shape = call.in(1).dimensions(), values = call.in(0).dimensions();
  const size_t rank = shape.size();
  Replay r{};
  r.B = shape[rank - 3], r.T = shape[rank - 2], r.N = shape[rank - 1];
  r.A = values[values.size() - 1];
  r.S = call.in(7).element_count() / 3;
  r.q = call.floats(0), r.beliefs = call.floats(1), r.actions = call.ints(2), r.rewards = call.floats(3);
  r.start = call.flags(4), r.valid = call.flags(5), r.terminated = call.flags(6), r.settings = call.floats(7);
  r.learnt = call.result(0);
  r.passes = *choices.get<int64_t>("passes");
  r.replacing = *choices.get<bool>("replacing"), r.greedy = *choices.get<bool>("greedy");
  const double work = 1.0 * r.passes * r.S * r.B * r.T * (r.N + 32) * (r.A + 2);
  return done(parallel(r.S, useful_threads(work), [&] {
    return [learner = std::make_shared<Learner>(r)](Index model) { learner->learn(model); };
  }));
}

// A model, values, draws and levels, a world, settings; results: the new q, steps taken, and the log.
ffi::Error act(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary choices) {
  const Call call{args, rets};
  const auto q = call.in(3).dimensions(), draws = call.in(4).dimensions(), world = call.in(7).dimensions();
  Acting w{};
  w.S = q[0], w.models = call.in(0).dimensions()[0], w.N = q[1], w.A = q[2], w.O = call.in(2).dimensions()[1];
  w.X = world[1], w.K = world[2], w.trials = draws[1] - 1, w.limit = draws[2] - 1, w.noted = w.trials * w.limit;
  w.init = call.floats(0), w.trans = call.floats(1), w.log_obs = call.floats(2), w.q = call.floats(3);
  w.draws = call.floats(4), w.level = call.floats(5), w.successors = call.ints(6);
  w.transition_cdf = call.floats(7), w.reward = call.floats(8), w.observation_cdf = call.floats(9);
  w.first_cdf = call.floats(10), w.start_cdf = call.floats(11), w.terminal = call.flags(12);
  w.reward_noise = *call.floats(13), w.settings = call.floats(14);
  w.seen_by_action = call.in(9).dimensions()[0] > 1;
  w.replacing = *choices.get<bool>("replacing"), w.greedy_rule = *choices.get<bool>("greedy");
  w.boltzmann = *choices.get<bool>("boltzmann");
  w.learnt = call.result(0), w.steps = call.result<int32_t>(1);
  w.observation = call.result<int32_t>(2), w.action = call.result<int32_t>(3), w.paid = call.result(4);
  w.arrived = call.result<int32_t>(5), w.active = call.result<bool>(6), w.ended = call.result<bool>(7);
  w.terminated = call.result<bool>(8), w.best = call.result(9);
  for (size_t i = 1; i < 10; ++i) std::memset(call.out(i).untyped_data(), 0, call.out(i).size_bytes());
  return done(parallel(w.S, useful_threads(1.0 * w.S * w.trials * (w.N + 32) * w.N), [&] {
    return [player = std::make_shared<Player>(w)](Index seed) { player->play(seed); };
  }));
}

auto binding() { return ffi::Ffi::Bind().RemainingArgs().RemainingRets().Attrs(); }

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpFilter, filter_tapes, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpEstep, estep, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpReplay, replay, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpAct, act, binding());
