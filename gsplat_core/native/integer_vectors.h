// Vectors of bytes and of 16-bit words of any width, for CPU kernels (*_cpu.cpp).
#pragma once

#include "simd.h"

namespace GSPLAT_ISA {

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

}  // namespace GSPLAT_ISA
