// Loops over the disparities of a pixel, bytes in vectors of a width that divides their number; the kernels of the CPU.
#pragma once

#include "simd.h"
#include "stereo_matching.h"

namespace GSPLAT_ISA::stereo_matching {

using namespace gsplat::stereo_matching;

constexpr int kMostWide = 4 * kLanes;  // bytes of a register

template <class Number>
GSPLAT_INLINE Number less(Number a, Number b) {
  return a < b ? a : b;
}
template <class Number>
GSPLAT_INLINE Number more(Number a, Number b) {
  return a > b ? a : b;
}
GSPLAT_INLINE int64_t within(int64_t i, int64_t size) { return less(more(i, int64_t(0)), size - 1); }

// Calls work with the widest of 64, 32 and 16 bytes, as a constant, that divides `count` and is no wider than `kMost`.
template <int kWide>
struct Width {
  static constexpr int value = kWide;
};
template <int kMost = kMostWide, class Work>
GSPLAT_INLINE void with_width(int count, const Work& work) {
  if (kMost >= 64 && count % 64 == 0)
    work(Width<64>());
  else if (kMost >= 32 && count % 32 == 0)
    work(Width<32>());
  else
    work(Width<16>());
}

// The least of kWide bytes.
template <int kWide>
GSPLAT_INLINE uint8_t least_of(const uint8_t* values) {
#if defined(__AVX2__)
  __m128i least = _mm_loadu_si128((const __m128i*)values);
  for (int i = 16; i < kWide; i += 16) least = _mm_min_epu8(least, _mm_loadu_si128((const __m128i*)(values + i)));
  const __m128i pairs = _mm_min_epu8(least, _mm_srli_epi16(least, 8));
  return uint8_t(_mm_cvtsi128_si32(_mm_minpos_epu16(_mm_and_si128(pairs, _mm_set1_epi16(0xff)))));
#else
  uint8_t least = values[0];
  for (int i = 1; i < kWide; ++i) least = less(least, values[i]);
  return least;
#endif
}

// In costs_cpu.cpp and winners_cpu.cpp.
int64_t cost_scratch(const Pair& pair);
void sum_costs(const Pair& pair, uint8_t* costs, int64_t begin, int64_t end, uint8_t* scratch);
void winners(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin, int64_t end,
             uint32_t* scratch);
void drop_patches(const Pair& pair, int32_t* sixteenths, int32_t* scratch);
void surfaces(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch);

}  // namespace GSPLAT_ISA::stereo_matching
