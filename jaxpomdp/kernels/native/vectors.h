// Vectors of the machine's width, exp, and small matrix products held in registers.

#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE__)
#include <immintrin.h>
#endif

namespace {

using Index = int64_t;

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

constexpr float kNeg = -1e30f;         // the logarithm of an absent thing
constexpr float kImpossible = -5e29f;  // log-probabilities below it stand for zero
constexpr float kOverlapFloor = 1e-30f;

inline Vec load(const float* p) { return *reinterpret_cast<const LooseVec*>(p); }
inline void store(float* p, Vec v) { *reinterpret_cast<LooseVec*>(p) = v; }
inline Vec splat(float x) { return x - Vec{}; }

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

inline Vec larger(Vec a, Vec b) {
#if defined(__AVX512F__)
  return (Vec)_mm512_max_ps((__m512)a, (__m512)b);
#else
  return a > b ? a : b;
#endif
}

// Calls f(n, count) for each vector of a row of N numbers; only the last may be short.
template <class F>
inline void sweep(Index N, F f) {
  Index n = 0;
  for (; n + kWidth <= N; n += kWidth) f(n, kWidth);
  if (n < N) f(n, N - n);
}

// 2^n p for whole n from -150 to 0; below the smallest normal float, zero.
inline Vec scale_by_power(Vec p, Vec n) {
#if defined(__AVX512F__)
  return (Vec)_mm512_scalef_ps((__m512)p, (__m512)n);
#else
  const Vec shifter = splat(12582912.0f);  // 1.5 * 2^23: whole numbers land in the lowest bits
  Vec power = (Vec)(((IntVec)(n + shifter) - (IntVec)shifter + 127) << 23);
  return n > splat(-126.5f) ? p * power : Vec{};
#endif
}

inline Vec round_whole(Vec x) {
#if defined(__AVX512F__)
  return (Vec)_mm512_roundscale_ps((__m512)x, 0);
#else
  const Vec shifter = splat(12582912.0f);
  return (x + shifter) - shifter;
#endif
}

// exp(x) for x <= 0, relative error 1e-7; zero below the smallest normal float.
// x = n ln 2 + r, ln 2 in two parts; a minimax polynomial for |r| <= ln 2 / 2.
inline Vec exp_negative(Vec x) {
  x = larger(x, splat(-104.0f));
  const Vec n = round_whole(x * 1.44269504f);
  const Vec r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
  Vec p = splat(1.38131435e-3f);
  p = p * r + 8.36941895e-3f;
  p = p * r + 4.16684568e-2f;
  p = p * r + 0.166665148f;
  p = p * r + 0.499999931f;
  p = p * r + 1.0f;
  return scale_by_power(p * r + 1.0f, n);
}

// out = exp(row - its largest), which it returns.
inline float relative(const float* row, float* out, Index N) {
  Vec best = splat(kNeg);
  sweep(N, [&](Index n, Index count) { best = larger(best, load_first(row + n, count, kNeg)); });
  const float shift = peak(best);
  sweep(N, [&](Index n, Index count) {
    store_first(out + n, count, exp_negative(load_first(row + n, count, kNeg) - splat(shift)));
  });
  return shift;
}

constexpr Index kTileRows = 6, kTileVecs = 4;

// out[r][c] (+)= sum_k x[r][k * stride] * m[k * ld + c] for R rows and C vectors of columns.
#define JAXPOMDP_UNROLL _Pragma("GCC unroll 8")
template <int R, int C>
void tile(const float* const* x, Index stride, const float* m, Index ld, Index depth, float* const* out,
          Index column, bool add) {
  constexpr int U = R * C <= 4 ? 4 : R * C <= 8 ? 2 : 1;  // several sums hide the latency of few
  Vec acc[U][R][C];
  JAXPOMDP_UNROLL
  for (auto& part : acc)
    JAXPOMDP_UNROLL
    for (auto& row : part)
      JAXPOMDP_UNROLL
      for (Vec& v : row) v = Vec{};
  const float* rows[R];
  JAXPOMDP_UNROLL
  for (int r = 0; r < R; ++r) rows[r] = x[r];
  auto fma = [&](Index k, int u) {
    Vec right[C];
    JAXPOMDP_UNROLL
    for (int c = 0; c < C; ++c) right[c] = load(m + k * ld + column + c * kWidth);
    JAXPOMDP_UNROLL
    for (int r = 0; r < R; ++r) {
      Vec left = splat(rows[r][k * stride]);
      JAXPOMDP_UNROLL
      for (int c = 0; c < C; ++c) acc[u][r][c] += left * right[c];
    }
  };
  Index k = 0;
  for (; k + U <= depth; k += U)
    JAXPOMDP_UNROLL
    for (int u = 0; u < U; ++u) fma(k + u, u);
  for (; k < depth; ++k) fma(k, 0);
  JAXPOMDP_UNROLL
  for (int r = 0; r < R; ++r)
    JAXPOMDP_UNROLL
    for (int c = 0; c < C; ++c) {
      Vec total = acc[0][r][c];
      JAXPOMDP_UNROLL
      for (int u = 1; u < U; ++u) total += acc[u][r][c];
      float* to = out[r] + column + c * kWidth;
      store(to, add ? load(to) + total : total);
    }
}

using Tile = void (*)(const float* const*, Index, const float*, Index, Index, float* const*, Index, bool);
#define JAXPOMDP_TILES(R) {tile<R, 1>, tile<R, 2>, tile<R, 3>, tile<R, 4>}
const Tile kTiles[kTileRows][kTileVecs] = {JAXPOMDP_TILES(1), JAXPOMDP_TILES(2), JAXPOMDP_TILES(3),
                                           JAXPOMDP_TILES(4), JAXPOMDP_TILES(5), JAXPOMDP_TILES(6)};

// The next piece of what is left: at most `most`, and the last two about even.
inline Index even_share(Index left, Index most) { return left <= most ? left : left < 2 * most ? (left + 1) / 2 : most; }

// The same for any number of rows and columns: even panels of columns, each staying in the first cache.
void multiply(const float* const* x, Index stride, const float* m, Index ld, Index depth, float* const* out,
              Index rows, Index vecs, bool add) {
  for (Index from = 0, width; from < vecs; from += width) {
    width = even_share(vecs - from, kTileVecs);
    for (Index first = 0, height; first < rows; first += height) {
      height = even_share(rows - first, kTileRows);
      kTiles[height - 1][width - 1](x + first, stride, m, ld, depth, out + first, from * kWidth, add);
    }
  }
}

}  // namespace
