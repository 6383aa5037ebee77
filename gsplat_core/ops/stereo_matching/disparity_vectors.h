// Vectors of bytes and of 16-bit words over a pixel's disparities, with a width that divides their number. For CPU
// kernels.
#pragma once

#include "simd.h"
#include "stereo_matching.h"

namespace GSPLAT_ISA::stereo_matching {

using namespace gsplat::stereo_matching;

constexpr int kRegisterBytes = 4 * kLanes;

template <int kWide>
struct Vector {
  typedef uint8_t Bytes __attribute__((vector_size(kWide)));
  typedef uint16_t Words __attribute__((vector_size(2 * kWide)));
};

template <class Values>
GSPLAT_INLINE Values load_as(const void* from) {
  Values values;
  __builtin_memcpy(&values, from, sizeof(values));
  return values;
}
template <class Values>
GSPLAT_INLINE void store_as(void* to, Values values) {
  __builtin_memcpy(to, &values, sizeof(values));
}

// Smaller and larger of two numbers, or of two vectors lane by lane.
template <class Values>
GSPLAT_INLINE Values less(Values a, Values b) {
  return a < b ? a : b;
}
template <class Values>
GSPLAT_INLINE Values more(Values a, Values b) {
  return a > b ? a : b;
}
GSPLAT_INLINE int64_t within(int64_t i, int64_t size) { return less(more(i, int64_t(0)), size - 1); }

// Call work with the widest of 64, 32 and 16 lanes, as a constant, that divides `count` and does not exceed kMost.
template <int kWide>
struct Width {
  static constexpr int value = kWide;
};
template <int kMost, class Work>
GSPLAT_INLINE void with_width(int count, const Work& work) {
  if (kMost >= 64 && count % 64 == 0)
    work(Width<64>());
  else if (kMost >= 32 && count % 32 == 0)
    work(Width<32>());
  else
    work(Width<16>());
}

// Return the minimum over the lanes.
template <class Words>
GSPLAT_INLINE uint16_t least_word(Words values) {
  uint16_t each[sizeof(Words) / 2];
  store_as(each, values);
#if defined(__AVX2__)
  __m128i least = load_as<__m128i>(each);
  for (size_t i = 8; i < sizeof(Words) / 2; i += 8) least = _mm_min_epu16(least, load_as<__m128i>(each + i));
  return uint16_t(_mm_cvtsi128_si32(_mm_minpos_epu16(least)));
#else
  uint16_t least = each[0];
  for (size_t i = 1; i < sizeof(Words) / 2; ++i) least = less(least, each[i]);
  return least;
#endif
}
template <class Bytes>
GSPLAT_INLINE uint8_t least_byte(Bytes values) {
  uint8_t each[sizeof(Bytes)];
  store_as(each, values);
#if defined(__AVX2__)
  __m128i least = load_as<__m128i>(each);
  for (size_t i = 16; i < sizeof(Bytes); i += 16) least = _mm_min_epu8(least, load_as<__m128i>(each + i));
  least = _mm_and_si128(_mm_min_epu8(least, _mm_srli_epi16(least, 8)), _mm_set1_epi16(0xff));
  return uint8_t(_mm_cvtsi128_si32(_mm_minpos_epu16(least)));
#else
  uint8_t least = each[0];
  for (size_t i = 1; i < sizeof(Bytes); ++i) least = less(least, each[i]);
  return least;
#endif
}

// Kernels defined in costs_cpu.cpp and winners_cpu.cpp, with the scratch memory that they need.
int64_t cost_scratch(const Pair& pair);
void sum_costs(const Pair& pair, uint8_t* costs, int64_t begin, int64_t end, uint8_t* scratch);
void winners(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin, int64_t end,
             uint32_t* scratch);
void drop_patches(const Pair& pair, int32_t* sixteenths, int32_t* scratch);
void surfaces(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch);

}  // namespace GSPLAT_ISA::stereo_matching
