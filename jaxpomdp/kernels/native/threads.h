// Threads that share work, aligned memory, and large pages.

#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <cstring>
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

#include "vectors.h"

namespace {

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
    } catch (...) {  // only memory can run out; an exception must not leave a thread
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

}  // namespace
