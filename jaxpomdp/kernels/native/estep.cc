// Expected counts, filtering and SARSA replay on the CPU, behind JAX's foreign function interface.
//
// Rows of one model run in step: at each time the rows that took the same action share one small matrix
// product, and the expected transitions are one product per action over blocks of steps. Probabilities are
// renormalised at every step; a row where underflow mattered is done again in logarithms and double precision.
// The semantics are those of kernels/smoothing.py and kernels/filtering.py, which are the tests' oracle.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__SSE__)
#include <immintrin.h>
#endif
#if defined(__linux__)
#include <sched.h>
#include <sys/mman.h>
#endif

#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using Index = int64_t;

// ---------------------------------------------------------------- vectors

#if defined(__AVX512F__)
constexpr Index kWidth = 16;
#elif defined(__AVX__)
constexpr Index kWidth = 8;
#else
constexpr Index kWidth = 4;
#endif
typedef float Vec __attribute__((vector_size(kWidth * 4), may_alias));
typedef float LooseVec __attribute__((vector_size(kWidth * 4), aligned(4), may_alias));
typedef int32_t IntVec __attribute__((vector_size(kWidth * 4), may_alias));

constexpr float kNeg = -1e30f;        // the logarithm of an absent thing
constexpr float kImpossible = -5e29f;  // log-probabilities below it stand for zero
constexpr float kOverlapFloor = 1e-30f;

inline Vec load(const float* p) { return *reinterpret_cast<const LooseVec*>(p); }
inline void store(float* p, Vec v) { *reinterpret_cast<LooseVec*>(p) = v; }
inline Vec splat(float x) { return Vec{} + x; }

inline Vec load_first(const float* p, Index count, float rest) {
  if (count >= kWidth) return load(p);
#if defined(__AVX512F__)
  return (Vec)_mm512_mask_loadu_ps(_mm512_set1_ps(rest), (__mmask16)((1u << count) - 1), p);
#else
  float lanes[kWidth];
  for (Index i = 0; i < kWidth; ++i) lanes[i] = i < count ? p[i] : rest;
  return load(lanes);
#endif
}

inline void store_first(float* p, Index count, Vec v) {
  if (count >= kWidth) return store(p, v);
#if defined(__AVX512F__)
  _mm512_mask_storeu_ps(p, (__mmask16)((1u << count) - 1), (__m512)v);
#else
  std::memcpy(p, &v, count * sizeof(float));
#endif
}

inline float sum(Vec v) {
#if defined(__AVX512F__)
  return _mm512_reduce_add_ps((__m512)v);
#else
  float total = 0;
  for (Index i = 0; i < kWidth; ++i) total += v[i];
  return total;
#endif
}

inline float peak(Vec v) {
#if defined(__AVX512F__)
  return _mm512_reduce_max_ps((__m512)v);
#else
  float best = v[0];
  for (Index i = 1; i < kWidth; ++i) best = v[i] > best ? v[i] : best;
  return best;
#endif
}

inline Vec larger(Vec a, Vec b) { return a > b ? a : b; }

// exp(x) for x <= 0, relative error about 1e-7; exactly zero below -87.
inline Vec exp_negative(Vec x) {
  const Vec shifter = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
  Vec inside = larger(x, splat(-87.0f));
  Vec turns = inside * 1.44269504f + shifter;
  IntVec power = (IntVec)turns - (IntVec)shifter;
  turns -= shifter;
  Vec r = inside - turns * 0.693359375f;
  r = r + turns * 2.12194440e-4f;
  Vec p = splat(1.9875691500e-4f);
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * r * r + r + 1.0f;
  Vec scaled = p * (Vec)((power + 127) << 23);
  return x > splat(-87.0f) ? scaled : Vec{};
}

// ---------------------------------------------------------------- small matrix products

constexpr Index kTileRows = 6, kTileVecs = 4;

// out[r][c] (+)= sum_k x[r][k * stride] * m[k * ld + c] for R rows and C vectors of columns.
template <int R, int C>
void tile(const float* const* x, Index stride, const float* m, Index ld, Index depth, float* const* out,
          Index column, bool add) {
  constexpr int U = R * C <= 4 ? 4 : R * C <= 8 ? 2 : 1;  // several sums hide the latency of few
  Vec acc[U][R][C] = {};
  const float* rows[R];
  for (int r = 0; r < R; ++r) rows[r] = x[r];
  auto fma = [&](Index k, int u) {
    Vec right[C];
    for (int c = 0; c < C; ++c) right[c] = load(m + k * ld + column + c * kWidth);
    for (int r = 0; r < R; ++r) {
      Vec left = splat(rows[r][k * stride]);
      for (int c = 0; c < C; ++c) acc[u][r][c] += left * right[c];
    }
  };
  Index k = 0;
  for (; k + U <= depth; k += U)
    for (int u = 0; u < U; ++u) fma(k + u, u);
  for (; k < depth; ++k) fma(k, 0);
  for (int r = 0; r < R; ++r)
    for (int c = 0; c < C; ++c) {
      Vec total = acc[0][r][c];
      for (int u = 1; u < U; ++u) total += acc[u][r][c];
      float* to = out[r] + column + c * kWidth;
      store(to, add ? load(to) + total : total);
    }
}

using Tile = void (*)(const float* const*, Index, const float*, Index, Index, float* const*, Index, bool);
#define JAXPOMDP_TILES(R) {tile<R, 1>, tile<R, 2>, tile<R, 3>, tile<R, 4>}
const Tile kTiles[kTileRows][kTileVecs] = {JAXPOMDP_TILES(1), JAXPOMDP_TILES(2), JAXPOMDP_TILES(3),
                                           JAXPOMDP_TILES(4), JAXPOMDP_TILES(5), JAXPOMDP_TILES(6)};

// The same for any number of rows and columns: even panels of columns, each staying in the first cache.
void multiply(const float* const* x, Index stride, const float* m, Index ld, Index depth, float* const* out,
              Index rows, Index vecs, bool add) {
  Index panels = (vecs + kTileVecs - 1) / kTileVecs, blocks = (rows + kTileRows - 1) / kTileRows;
  for (Index p = 0; p < panels; ++p) {
    Index from = vecs * p / panels, width = vecs * (p + 1) / panels - from;
    for (Index b = 0; b < blocks; ++b) {
      Index first = rows * b / blocks, height = rows * (b + 1) / blocks - first;
      kTiles[height - 1][width - 1](x + first, stride, m, ld, depth, out + first, from * kWidth, add);
    }
  }
}

// ---------------------------------------------------------------- threads and memory

Index thread_count() {
  if (const char* set = std::getenv("JAXPOMDP_THREADS"))
    if (int asked = std::atoi(set); asked > 0) return asked;
#if defined(__linux__)
  cpu_set_t mask;
  if (sched_getaffinity(0, sizeof(mask), &mask) == 0) return std::max(1, CPU_COUNT(&mask));
#endif
  return std::max(1u, std::thread::hardware_concurrency());
}

// Numbers below the smallest normal float cost a hundred cycles each: flush them while we compute.
struct FlushTiny {
#if defined(__SSE__)
  unsigned before = _mm_getcsr();
  FlushTiny() { _mm_setcsr(before | 0x8040); }
  ~FlushTiny() { _mm_setcsr(before); }
#endif
};

// Runs make()(i) for i < count, `make` once per thread; false if memory ran out.
template <class Make>
bool parallel(Index count, Index threads, Make make) {
  std::atomic<Index> next{0};
  std::atomic<bool> fine{true};
  auto work = [&] {
    try {
      FlushTiny guard;
      auto run = make();
      for (Index i; (i = next++) < count;) run(i);
    } catch (const std::bad_alloc&) {
      fine = false;
    }
  };
  std::vector<std::thread> helpers;
  try {
    for (Index i = 1; i < std::min(threads, count); ++i) helpers.emplace_back(work);
  } catch (const std::system_error&) {  // fewer threads than hoped for will do
  }
  work();
  for (auto& helper : helpers) helper.join();
  return fine;
}

// Floats that start on a cache line, all zero.
class Floats {
 public:
  void resize(Index count) {
    memory_.assign(count + 16, 0);
    auto address = reinterpret_cast<uintptr_t>(memory_.data());
    data_ = memory_.data() + (64 - address % 64) % 64 / sizeof(float);
    count_ = count;
  }
  void clear() { std::memset(data_, 0, count_ * sizeof(float)); }
  float* operator+(Index offset) { return data_ + offset; }
  const float* operator+(Index offset) const { return data_ + offset; }

 private:
  std::vector<float> memory_;
  float* data_ = nullptr;
  Index count_ = 0;
};

// Fresh large outputs fault page by page: ask for large pages.
void prefer_large_pages(float* data, Index count) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr uintptr_t page = 2 << 20;
  auto from = (reinterpret_cast<uintptr_t>(data) + page - 1) / page * page;
  auto to = reinterpret_cast<uintptr_t>(data + count) / page * page;
  if (to > from) madvise(reinterpret_cast<void*>(from), to - from, MADV_HUGEPAGE);
#endif
}

// ---------------------------------------------------------------- forward and backward

// The batch: models s < S, rows b < B, steps t < T, states n < N, actions a < A.
struct Problem {
  Index S, B, T, N, A;
  const float *init, *trans, *log_obs;
  const int32_t* actions;
  const bool *start, *valid;
  float *belief, *log_norm;          // filter: probabilities and log-normalisers, [S, B, T, N] and [S, B, T]
  float *evidence, *xi, *initial;    // smoothing, where belief becomes gamma
  Index chunk_rows, chunks;          // rows of a model are cut into chunks, whatever the number of threads

  Index row(Index s, Index b) const { return (s * B + b) * T; }
};

// Rows that share an action now: where their vectors come from and go to.
struct Group {
  std::vector<const float*> from;
  std::vector<float*> to;
  std::vector<Index> lanes;
  void clear() { from.clear(), to.clear(), lanes.clear(); }
  void add(const float* x, float* out, Index lane) { from.push_back(x), to.push_back(out), lanes.push_back(lane); }
};

constexpr Index kBlock = 64;  // steps whose transitions are counted by one product

// One thread's workplace: it takes chunks of rows of a model one after the other.
class Worker {
 public:
  explicit Worker(const Problem& problem) : p_(problem) {
    vecs_ = (p_.N + kWidth - 1) / kWidth;
    ld_ = (vecs_ | 1) * kWidth;  // an odd number of vectors: rows spread over all cache sets
    groups_.resize(p_.A);
    trans_.resize(p_.A * p_.N * ld_);
    init_.resize(ld_);
    for (Floats* f : {&now_, &weight_}) f->resize(p_.chunk_rows * ld_);
    for (Floats* f : {&shift_, &norm_}) f->resize(p_.chunk_rows * p_.T);
    if (p_.xi == nullptr) return;
    back_.resize(p_.A * p_.N * ld_);
    for (Floats* f : {&left_, &right_}) f->resize(p_.A * kBlock * ld_);
    counts_.resize(p_.A * p_.N * ld_);
    filled_.assign(p_.A, 0);
  }

  void filter(Index unit) {
    enter(unit);
    forward();
    for (Index lane = 0; lane < lanes_; ++lane)
      failed_[lane] ? exact(lane, nullptr, nullptr) : write_norms(lane);
  }

  // Writes gamma and evidence; xi and initial of these rows go to `xi` [A, N, N] and `initial` [N].
  void smooth(Index unit, float* xi, float* initial) {
    enter(unit);
    do {
      counts_.clear();
      std::fill(filled_.begin(), filled_.end(), 0);
      std::fill(initial, initial + p_.N, 0.0f);
      initial_ = initial;
      forward();
    } while (!backward());  // again without the rows whose underflow showed only now
    scale_counts(xi);
    for (Index lane = 0; lane < lanes_; ++lane)
      if (failed_[lane]) exact(lane, xi, initial);
  }

 private:
  void enter(Index unit) {
    model_ = unit / p_.chunks;
    Index part = unit % p_.chunks;
    first_row_ = p_.B * part / p_.chunks;
    lanes_ = p_.B * (part + 1) / p_.chunks - first_row_;
    failed_.assign(lanes_, false);
    evidence_.assign(lanes_, 0.0);
    Index nn = p_.N * p_.N;
    std::memcpy(init_ + 0, p_.init + model_ * p_.N, p_.N * sizeof(float));
    const float* source = p_.trans + model_ * p_.A * nn;
    for (Index i = 0; i < p_.A * p_.N; ++i)
      std::memcpy(trans_ + i * ld_, source + i * p_.N, p_.N * sizeof(float));
    if (p_.xi == nullptr) return;
    for (Index a = 0; a < p_.A; ++a)
      for (Index j = 0; j < p_.N; ++j)
        for (Index i = 0; i < p_.N; ++i) *(back_ + (a * p_.N + j) * ld_ + i) = source[a * nn + i * p_.N + j];
  }

  Index at(Index lane, Index t) const { return p_.row(model_, first_row_ + lane) + t; }
  float* belief(Index lane, Index t) { return p_.belief + at(lane, t) * p_.N; }
  bool valid(Index lane, Index t) const { return p_.valid[at(lane, t)]; }
  bool first(Index lane, Index t) const { return t == 0 || p_.start[at(lane, t)] || !valid(lane, t - 1); }
  bool last(Index lane, Index t) const { return t == p_.T - 1 || p_.start[at(lane, t + 1)] || !valid(lane, t + 1); }
  Index action(Index lane, Index t) const {
    return std::clamp<Index>(p_.actions[at(lane, t)], 0, p_.A - 1);  // out of range: as a clamped gather
  }

  void multiply_groups(const Floats& matrices) {
    for (Index a = 0; a < p_.A; ++a) {
      Group& g = groups_[a];
      multiply(g.from.data(), 1, matrices + a * p_.N * ld_, ld_, p_.N, g.to.data(), g.lanes.size(), vecs_, false);
    }
  }

  void forward() {
    live_.clear();
    products_.assign(lanes_, 1.0);
    for (Index lane = 0; lane < lanes_; ++lane)
      if (!failed_[lane]) live_.push_back(lane), evidence_[lane] = 0;
    for (Index t = 0; t < p_.T; ++t) {
      for (Group& g : groups_) g.clear();
      for (Index lane : live_) {
        if (!valid(lane, t)) continue;
        if (first(lane, t)) std::memcpy(now_ + lane * ld_, init_ + 0, ld_ * sizeof(float));
        else groups_[action(lane, t - 1)].add(belief(lane, t - 1), now_ + lane * ld_, lane);
      }
      multiply_groups(trans_);
      for (Index lane : live_) valid(lane, t) ? observe(lane, t) : skip(lane, t);
    }
    for (Index lane : live_) evidence_[lane] += std::log(products_[lane]);
  }

  void skip(Index lane, Index t) { std::memset(belief(lane, t), 0, p_.N * sizeof(float)); }

  // belief ∝ predicted * exp(log_obs - shift); an observation that no state allows is ignored.
  void observe(Index lane, Index t) {
    const float* row = p_.log_obs + at(lane, t) * p_.N;
    float *now = now_ + lane * ld_, *out = belief(lane, t);
    Vec best = splat(kNeg);
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) best = larger(best, load_first(row + n, p_.N - n, kNeg));
    float shift = peak(best);
    *(shift_ + lane * p_.T + t) = shift;
    if (shift < kImpossible) {
      *(norm_ + lane * p_.T + t) = 1;
      evidence_[lane] += kNeg;
      std::memcpy(out, now, p_.N * sizeof(float));
      return;
    }
    Vec total{};
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) {
      Vec joint = load(now + n) * exp_negative(load_first(row + n, p_.N - n, kNeg) - shift);
      total += joint;
      store(now + n, joint);
    }
    float norm = sum(total), scale = 1 / norm;
    *(norm_ + lane * p_.T + t) = norm;
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) store_first(out + n, p_.N - n, load(now + n) * scale);
    if (!(norm >= kOverlapFloor)) failed_[lane] = true;
    evidence_[lane] += shift;
    products_[lane] *= norm;
    if (products_[lane] < 1e-200) evidence_[lane] += std::log(products_[lane]), products_[lane] = 1;
  }

  void write_norms(Index lane) {
    for (Index t = 0; t < p_.T; ++t) {
      float shift = *(shift_ + lane * p_.T + t);
      float norm = shift < kImpossible ? kNeg : std::log(*(norm_ + lane * p_.T + t)) + shift;
      p_.log_norm[at(lane, t)] = valid(lane, t) ? norm : 0;
    }
  }

  bool backward() {
    live_.clear();
    for (Index lane = 0; lane < lanes_; ++lane)
      if (!failed_[lane]) live_.push_back(lane);
    bool fine = true;
    for (Index t = p_.T - 1; t >= 0; --t) {
      for (Group& g : groups_) g.clear();
      for (Index lane : live_)
        if (valid(lane, t) && !last(lane, t))
          groups_[action(lane, t)].add(weight_ + lane * ld_, now_ + lane * ld_, lane);
      multiply_groups(back_);
      for (Index lane : live_)
        if (valid(lane, t)) {
          if (last(lane, t)) std::fill_n(now_ + lane * ld_, p_.N, 1.0f);
          if (!combine(lane, t)) failed_[lane] = true, fine = false;
        }
    }
    for (Index a = 0; a < p_.A; ++a) count_block(a);
    for (Index lane : live_) p_.evidence[p_.B * model_ + first_row_ + lane] = evidence_[lane];
    return fine;
  }

  // gamma from belief and future; the step's transitions into its action's block; the weight for the step before.
  bool combine(Index lane, Index t) {
    float *alpha = belief(lane, t), *now = now_ + lane * ld_, *weight = weight_ + lane * ld_;
    Vec total{};
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) total += load_first(alpha + n, p_.N - n, 0) * load(now + n);
    float overlap = sum(total), scale = 1 / overlap;
    if (!(overlap * *(norm_ + lane * p_.T + t) >= kOverlapFloor)) return false;
    if (!last(lane, t)) {
      Index a = action(lane, t), slot = (a * kBlock + filled_[a]) * ld_;
      for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) {
        store(left_ + (slot + n), load_first(alpha + n, p_.N - n, 0) * scale);
        store(right_ + (slot + n), load(weight + n));
      }
      if (++filled_[a] == kBlock) count_block(a);
    }
    bool begins = first(lane, t);
    float shift = *(shift_ + lane * p_.T + t);
    const float* row = p_.log_obs + at(lane, t) * p_.N;
    Vec mass{};
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) {
      Vec future = load(now + n), gamma = load_first(alpha + n, p_.N - n, 0) * future * scale;
      store_first(alpha + n, p_.N - n, gamma);
      if (begins) {
        store_first(initial_ + n, p_.N - n, gamma + load_first(initial_ + n, p_.N - n, 0));
        continue;
      }
      Vec here = shift < kImpossible ? future : future * exp_negative(load_first(row + n, p_.N - n, kNeg) - shift);
      mass += here;
      store(weight + n, here);
    }
    if (begins) return true;
    float rescale = 1 / sum(mass);
    for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth) store(weight + n, load(weight + n) * rescale);
    return true;
  }

  // counts[a] += left^T right over the block.
  void count_block(Index a) {
    rows_from_.resize(p_.N), rows_to_.resize(p_.N);
    for (Index i = 0; i < p_.N; ++i) {
      rows_from_[i] = left_ + (a * kBlock * ld_ + i);
      rows_to_[i] = counts_ + (a * p_.N + i) * ld_;
    }
    multiply(rows_from_.data(), ld_, right_ + a * kBlock * ld_, ld_, filled_[a], rows_to_.data(), p_.N, vecs_, true);
    filled_[a] = 0;
  }

  void scale_counts(float* xi) {
    for (Index i = 0; i < p_.A * p_.N; ++i)
      for (Index v = 0, n = 0; v < vecs_; ++v, n += kWidth)
        store_first(xi + i * p_.N + n, p_.N - n, load(counts_ + (i * ld_ + n)) * load(trans_ + (i * ld_ + n)));
  }

  void exact(Index lane, float* xi, float* initial);
  std::vector<double> exact_forward(Index lane, std::vector<double>& log_belief);
  void exact_counts(const double* belief, const double* weight, double norm, Index a, float* xi);

  const Problem& p_;
  Index vecs_, ld_, model_ = 0, first_row_ = 0, lanes_ = 0;
  std::vector<Group> groups_;
  Floats trans_, back_, init_, now_, weight_, shift_, norm_, left_, right_, counts_;
  std::vector<Index> filled_, live_;
  std::vector<char> failed_;
  std::vector<double> evidence_, products_;
  std::vector<const float*> rows_from_;
  std::vector<float*> rows_to_;
  float* initial_ = nullptr;
};

// ---------------------------------------------------------------- the exact route

constexpr double kNone = -1e30, kNoneBelow = -5e29;

double log_sum_exp(const double* x, Index count) {
  double best = *std::max_element(x, x + count), total = 0;
  if (best < kNoneBelow) return kNone;
  for (Index i = 0; i < count; ++i) total += std::exp(x[i] - best);
  return best + std::log(total);
}

// out_j = log sum_i exp(x_i) m[i * row + j * column]: a product, or term by term where that would underflow.
void log_product(const double* x, const float* m, Index N, Index row, Index column, double* out) {
  double best = *std::max_element(x, x + N);
  std::vector<double> weight(N), term(N);
  for (Index i = 0; i < N; ++i) weight[i] = best < kNoneBelow ? 0 : std::exp(x[i] - best);
  for (Index j = 0; j < N; ++j) {
    double total = 0;
    for (Index i = 0; i < N; ++i) total += weight[i] * m[i * row + j * column];
    if (total > 1e-280) {
      out[j] = best + std::log(total);
      continue;
    }
    for (Index i = 0; i < N; ++i) {
      double step = m[i * row + j * column];
      term[i] = step > 0 ? std::max(x[i] + std::log(step), kNone) : kNone;
    }
    out[j] = log_sum_exp(term.data(), N);
  }
}

// Log-beliefs [T, N] of a row; returns its log-normalisers [T], kNone where the observation is ignored.
std::vector<double> Worker::exact_forward(Index lane, std::vector<double>& log_belief) {
  const Index N = p_.N;
  const float* trans = p_.trans + model_ * p_.A * N * N;
  std::vector<double> norms(p_.T, 0.0), predicted(N), joint(N);
  for (Index t = 0; t < p_.T; ++t) {
    if (!valid(lane, t)) continue;
    const float *row = p_.log_obs + at(lane, t) * N, *init = p_.init + model_ * N;
    if (first(lane, t))
      for (Index n = 0; n < N; ++n) predicted[n] = init[n] > 0 ? std::log((double)init[n]) : kNone;
    else
      log_product(&log_belief[(t - 1) * N], trans + action(lane, t - 1) * N * N, N, N, 1, predicted.data());
    for (Index n = 0; n < N; ++n) joint[n] = std::max(predicted[n] + row[n], kNone);
    norms[t] = log_sum_exp(joint.data(), N);
    bool heeded = norms[t] > kNoneBelow;
    if (!heeded) norms[t] = kNone;
    for (Index n = 0; n < N; ++n)
      log_belief[t * N + n] = heeded ? std::max(joint[n] - norms[t], kNone) : predicted[n];
  }
  return norms;
}

void Worker::exact_counts(const double* belief, const double* weight, double norm, Index a, float* xi) {
  const Index N = p_.N;
  const float* trans = p_.trans + (model_ * p_.A + a) * N * N;
  double best = *std::max_element(weight, weight + N);
  for (Index i = 0; i < N; ++i) {
    if (belief[i] + best - norm < -200) continue;  // adds nothing that a float could hold
    for (Index j = 0; j < N; ++j)
      if (weight[j] > kNoneBelow && trans[i * N + j] > 0)
        xi[(a * N + i) * N + j] += std::exp(belief[i] + weight[j] - norm) * trans[i * N + j];
  }
}

// A whole row in logarithms; without xi only the filter's results are written.
void Worker::exact(Index lane, float* xi, float* initial) {
  const Index N = p_.N;
  const float* trans = p_.trans + model_ * p_.A * N * N;
  std::vector<double> log_belief(p_.T * N, kNone), future(N), weight(N), joint(N);
  std::vector<double> norms = exact_forward(lane, log_belief);
  double evidence = 0;
  for (Index t = p_.T - 1; t >= 0; --t) {
    float* out = belief(lane, t);
    evidence += norms[t];
    if (xi == nullptr) p_.log_norm[at(lane, t)] = norms[t];
    if (!valid(lane, t)) {
      skip(lane, t);
      continue;
    }
    bool ends = xi == nullptr || last(lane, t);
    if (ends) std::fill(future.begin(), future.end(), 0.0);
    else log_product(weight.data(), trans + action(lane, t) * N * N, N, 1, N, future.data());
    const double* now = &log_belief[t * N];
    for (Index n = 0; n < N; ++n) joint[n] = std::max(now[n] + future[n], kNone);
    double norm = log_sum_exp(joint.data(), N);
    if (!ends && norm > kNoneBelow) exact_counts(now, weight.data(), norm, action(lane, t), xi);
    const float* row = p_.log_obs + at(lane, t) * N;
    for (Index n = 0; n < N; ++n) {
      out[n] = joint[n] > kNoneBelow ? std::exp(joint[n] - norm) : 0;
      if (xi != nullptr && first(lane, t)) initial[n] += out[n];
      weight[n] = std::max(future[n] + (norms[t] > kNoneBelow ? row[n] : 0), kNone);
    }
  }
  if (xi != nullptr) p_.evidence[p_.B * model_ + first_row_ + lane] = evidence;
}

// ---------------------------------------------------------------- entry points

Problem problem_of(ffi::Buffer<ffi::F32> init, ffi::Buffer<ffi::F32> trans, ffi::Buffer<ffi::F32> log_obs,
                   ffi::Buffer<ffi::S32> actions, ffi::Buffer<ffi::PRED> start, ffi::Buffer<ffi::PRED> valid) {
  auto dims = log_obs.dimensions(), square = trans.dimensions();
  size_t rank = dims.size();
  Problem p{};
  p.B = dims[rank - 3], p.T = dims[rank - 2], p.N = dims[rank - 1];
  p.A = square[square.size() - 3];
  p.S = p.N == 0 ? 0 : init.element_count() / p.N;
  p.init = init.typed_data(), p.trans = trans.typed_data(), p.log_obs = log_obs.typed_data();
  p.actions = actions.typed_data(), p.start = start.typed_data(), p.valid = valid.typed_data();
  p.chunks = std::clamp<Index>((p.B + 31) / 32, 1, 16);
  p.chunk_rows = (p.B + p.chunks - 1) / p.chunks;
  return p;
}

Index useful_threads(const Problem& p) {
  double work = 3.0 * p.S * p.B * p.T * (p.N + 32) * p.N;
  return std::clamp<Index>(work / 3e5, 1, thread_count());  // a thread takes some 20 microseconds to start
}

ffi::Error done(bool fine) { return fine ? ffi::Error::Success() : ffi::Error::Internal("jaxpomdp: out of memory"); }

ffi::Error filter_tapes(ffi::Buffer<ffi::F32> init, ffi::Buffer<ffi::F32> trans, ffi::Buffer<ffi::F32> log_obs,
                        ffi::Buffer<ffi::S32> actions, ffi::Buffer<ffi::PRED> start, ffi::Buffer<ffi::PRED> valid,
                        ffi::ResultBuffer<ffi::F32> belief, ffi::ResultBuffer<ffi::F32> log_norm) {
  Problem p = problem_of(init, trans, log_obs, actions, start, valid);
  p.belief = belief->typed_data(), p.log_norm = log_norm->typed_data();
  prefer_large_pages(p.belief, belief->element_count());
  return done(parallel(p.S * p.chunks, useful_threads(p), [&] {
    return [worker = std::make_shared<Worker>(p)](Index unit) { worker->filter(unit); };
  }));
}

// Adds the parts of a model's rows, in order.
void merge(const float* parts, Index count, Index size, float* out) {
  std::memcpy(out, parts, size * sizeof(float));
  for (Index part = 1; part < count; ++part)
    for (Index i = 0; i < size; ++i) out[i] += parts[part * size + i];
}

ffi::Error estep(ffi::Buffer<ffi::F32> init, ffi::Buffer<ffi::F32> trans, ffi::Buffer<ffi::F32> log_obs,
                 ffi::Buffer<ffi::S32> actions, ffi::Buffer<ffi::PRED> start, ffi::Buffer<ffi::PRED> valid,
                 ffi::ResultBuffer<ffi::F32> evidence, ffi::ResultBuffer<ffi::F32> gamma,
                 ffi::ResultBuffer<ffi::F32> xi, ffi::ResultBuffer<ffi::F32> initial) {
  Problem p = problem_of(init, trans, log_obs, actions, start, valid);
  p.belief = gamma->typed_data(), p.evidence = evidence->typed_data();
  p.xi = xi->typed_data(), p.initial = initial->typed_data();
  prefer_large_pages(p.belief, gamma->element_count());
  const Index cube = p.A * p.N * p.N, units = p.S * p.chunks;
  std::unique_ptr<float[]> xis(new (std::nothrow) float[units * cube]), starts(new (std::nothrow) float[units * p.N]);
  if (!xis || !starts) return done(false);
  bool fine = parallel(units, useful_threads(p), [&] {
    return [&, worker = std::make_shared<Worker>(p)](Index unit) {
      worker->smooth(unit, xis.get() + unit * cube, starts.get() + unit * p.N);
    };
  });
  for (Index s = 0; s < p.S; ++s) {
    merge(xis.get() + s * p.chunks * cube, p.chunks, cube, p.xi + s * cube);
    merge(starts.get() + s * p.chunks * p.N, p.chunks, p.N, p.initial + s * p.N);
  }
  return done(fine);
}

#define JAXPOMDP_TAPES                                                                                 \
  ffi::Ffi::Bind()                                                                                     \
      .Arg<ffi::Buffer<ffi::F32>>()                                                                    \
      .Arg<ffi::Buffer<ffi::F32>>()                                                                    \
      .Arg<ffi::Buffer<ffi::F32>>()                                                                    \
      .Arg<ffi::Buffer<ffi::S32>>()                                                                    \
      .Arg<ffi::Buffer<ffi::PRED>>()                                                                   \
      .Arg<ffi::Buffer<ffi::PRED>>()                                                                   \
      .Ret<ffi::Buffer<ffi::F32>>()                                                                    \
      .Ret<ffi::Buffer<ffi::F32>>()

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpFilter, filter_tapes, JAXPOMDP_TAPES);
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxpomdpEstep, estep,
                              JAXPOMDP_TAPES.Ret<ffi::Buffer<ffi::F32>>().Ret<ffi::Buffer<ffi::F32>>());
