// Expected counts, filtering, acting and SARSA replay on the CPU, behind JAX's foreign function interface.
//
// Most kernels let rows of one model run in step: at each time the rows that took the same action share one small
// matrix product, and the expected transitions are one product per action over blocks of steps. Probabilities are
// renormalised at every step; what underflow spoilt, a row or a step of it, is done again in double precision.
// The semantics are those of kernels/smoothing.py, kernels/filtering.py, kernels/coupled_exact.py,
// kernels/coupled_marginals.py, kernels/memory.py and agents/trial.py, the tests' oracles.

#include <algorithm>
#include <cstdint>
#include <memory>
#include <new>
#include <vector>

#include "act.h"
#include "coupled.h"
#include "coupled_exact.h"
#include "coupled_marginals.h"
#include "exact.h"
#include "memory.h"
#include "memory_exact.h"
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

// The last three arguments of a call on tapes: actions, start, valid.
void read_batch(const Call& call, size_t first, Batch& batch) {
  const auto shape = call.in(first).dimensions();
  batch.B = shape[shape.size() - 2], batch.T = shape[shape.size() - 1];
  batch.actions = call.ints(first), batch.start = call.flags(first + 1), batch.valid = call.flags(first + 2);
}

// init, trans, log_obs, actions, start, valid; leading axes beyond these, as vmap makes them, are more models.
Problem problem_of(const Call& call, bool counted) {
  const auto shape = call.in(2).dimensions(), square = call.in(1).dimensions();
  Problem p{};
  read_batch(call, 3, p);
  p.N = shape[shape.size() - 1];
  p.A = square[square.size() - 3];
  p.S = p.N == 0 ? 0 : call.in(0).element_count() / p.N;
  p.init = call.floats(0), p.trans = call.floats(1), p.log_obs = call.floats(2);
  p.counted = counted;
  p.plan_chunks(kChunkRows, p.A * p.N * p.N);
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

// Where units write what is summed over the rows of a model: into the result, or, where a model has several
// chunks, each apart, to be added in their order.
class Sums {
 public:
  Sums(const Batch& batch, float* result, Index size) : batch_(batch), result_(result), size_(size) {
    if (batch.chunks > 1) parts_.resize(batch.S * batch.chunks * size);
  }
  float* of(Index unit) { return (batch_.chunks > 1 ? parts_.data() : result_) + unit * size_; }
  void merge() {
    if (batch_.chunks == 1) return;
    const float* part = parts_.data();
    for (float* out = result_; out < result_ + batch_.S * size_; out += size_) {
      std::fill_n(out, size_, 0.0f);
      for (Index chunk = 0; chunk < batch_.chunks; ++chunk, part += size_)
        for (Index i = 0; i < size_; ++i) out[i] += part[i];
    }
  }

 private:
  const Batch& batch_;
  float* result_;
  Index size_;
  std::vector<float> parts_;
};

// Results: evidence, gamma, xi, initial.
ffi::Error estep(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary) try {
  const Call call{args, rets};
  Problem p = problem_of(call, true);
  p.evidence = call.result(0), p.belief = call.result(1);
  prefer_large_pages(p.belief, call.out(1).element_count());
  Sums xi(p, call.result(2), p.A * p.N * p.N), initial(p, call.result(3), p.N);
  const bool fine = parallel(p.S * p.chunks, useful_threads(multiplications(p)), [&] {
    return [&, worker = std::make_shared<Worker>(p)](Index unit) {
      worker->smooth(unit, xi.of(unit), initial.of(unit));
    };
  });
  xi.merge(), initial.merge();
  return done(fine);
} catch (const std::bad_alloc&) {
  return done(false);
}

// For each chain init, then trans, then log_obs; actions, start, valid. Results: evidence; for each chain gamma,
// then xi, then initial. The worker is that of exact inference or of the sweep over marginals.
template <class Worker>
ffi::Error coupled(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary) try {
  const Call call{args, rets};
  CoupledProblem p{};
  read_batch(call, 6, p);
  const auto shape = call.in(2).dimensions();
  p.A = shape[shape.size() - 4];
  for (int c = 0; c < 2; ++c) {
    p.N[c] = shape[shape.size() - 3 + c];
    p.init[c] = call.floats(c), p.trans[c] = call.floats(2 + c), p.log_obs[c] = call.floats(4 + c);
    p.gamma[c] = call.result(1 + c);
  }
  p.evidence = call.result(0);
  p.S = p.N[0] == 0 ? 0 : call.in(0).element_count() / p.N[0];
  const Index pairs = p.N[0] * p.N[1], cells = p.A * pairs;
  p.plan_chunks(Worker::kChunk, cells * (p.N[0] + p.N[1]));
  Sums xi[] = {{p, call.result(3), cells * p.N[0]}, {p, call.result(4), cells * p.N[1]}};
  Sums initial[] = {{p, call.result(5), p.N[0]}, {p, call.result(6), p.N[1]}};
  const bool fine = parallel(p.S * p.chunks, useful_threads(Worker::multiplications(p)), [&] {
    return [&, worker = std::make_shared<Worker>(p)](Index unit) {
      worker->smooth(unit, {{xi[0].of(unit), xi[1].of(unit)}, {initial[0].of(unit), initial[1].of(unit)}});
    };
  });
  for (int c = 0; c < 2; ++c) xi[c].merge(), initial[c].merge();
  return done(fine);
} catch (const std::bad_alloc&) {
  return done(false);
}

// init, trans, lead, heed, note, log_obs, actions, start, valid. Results: evidence, gamma, xi, initial, held; counts
// of chain, lead, heed, note.
ffi::Error memory(ffi::RemainingArgs args, ffi::RemainingRets rets, ffi::Dictionary) try {
  const Call call{args, rets};
  MemoryProblem p{};
  read_batch(call, 6, p);
  const auto shape = call.in(1).dimensions();
  p.N = shape[shape.size() - 1], p.A = shape[shape.size() - 3];
  p.S = p.N == 0 ? 0 : call.in(0).element_count() / p.N;
  p.init = call.floats(0), p.trans = call.floats(1), p.lead = call.floats(2), p.heed = call.floats(3);
  p.note = call.floats(4), p.log_obs = call.floats(5);
  p.evidence = call.result(0), p.gamma = call.result(1), p.held = call.result(4);
  const Index square = p.A * p.N * p.N, columns = p.most_awake() + 1;
  const Index affordable = (Index{16} << 20) / std::max<Index>(1, p.T * p.N * columns);  // beliefs in 64 MiB
  p.plan_chunks(std::clamp<Index>(affordable, 1, kMemoryRows), 3 * square);
  prefer_large_pages(p.gamma, call.out(1).element_count()), prefer_large_pages(p.held, call.out(4).element_count());
  Sums xi(p, call.result(2), square), initial(p, call.result(3), p.N);
  Sums chain(p, call.result(5), square), lead(p, call.result(6), square);
  Sums heed(p, call.result(7), 2 * p.N), note(p, call.result(8), 2 * p.N);
  const double work = 3.0 * p.S * p.B * p.T * (p.N + 32) * p.N * columns;
  const bool fine = parallel(p.S * p.chunks, useful_threads(work), [&] {
    return [&, worker = std::make_shared<MemoryWorker>(p)](Index unit) {
      worker->smooth(unit, {xi.of(unit), initial.of(unit), chain.of(unit), lead.of(unit), heed.of(unit),
                            note.of(unit)});
    };
  });
  for (Sums* sums : {&xi, &initial, &chain, &lead, &heed, &note}) sums->merge();
  return done(fine);
} catch (const std::bad_alloc&) {
  return done(false);
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
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpCoupled, coupled<CoupledWorker>, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpMarginals, coupled<MarginalWorker>, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpMemory, memory, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpReplay, replay, binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpAct, act, binding());
