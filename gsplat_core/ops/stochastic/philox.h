// Philox4x32-10 (Salmon et al. 2011): four random words from a counter of four words and a key of two, one counter per
// lane. Both devices produce the same words.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA {

#if defined(__CUDACC__)
typedef uint32_t vuint;
GSPLAT_INLINE vuint high_product(uint32_t a, vuint b) { return __umulhi(a, b); }
GSPLAT_INLINE vfloat to_float(vuint x) { return float(x); }
#else
typedef uint32_t vuint __attribute__((vector_size(kLanes * 4)));
typedef uint64_t vwide __attribute__((vector_size(kLanes * 8)));
GSPLAT_INLINE vuint high_product(uint32_t a, vuint b) {
  return __builtin_convertvector((__builtin_convertvector(b, vwide) * uint64_t(a)) >> 32, vuint);
}
// For x < 2^31.
GSPLAT_INLINE vfloat to_float(vuint x) { return __builtin_convertvector((vint)x, vfloat); }
GSPLAT_INLINE uint32_t high_product(uint32_t a, uint32_t b) { return uint32_t((uint64_t(a) * b) >> 32); }
#endif

template <class Word>
GSPLAT_INLINE void philox(Word c[4], uint32_t key0, uint32_t key1) {
  for (int round = 0; round < 10; ++round) {
    const Word high0 = high_product(0xD2511F53u, c[0]), low0 = c[0] * 0xD2511F53u;
    const Word high1 = high_product(0xCD9E8D57u, c[2]), low1 = c[2] * 0xCD9E8D57u;
    const Word first = high1 ^ c[1] ^ key0, third = high0 ^ c[3] ^ key1;
    c[0] = first;
    c[1] = low1;
    c[2] = third;
    c[3] = low0;
    key0 += 0x9E3779B9u;
    key1 += 0xBB67AE85u;
  }
}

// Return a number in [0, 1), a multiple of 2^-24.
GSPLAT_INLINE vfloat unit_interval(vuint x) { return to_float(x >> 8) * 5.9604644775390625e-8f; }
#if !defined(__CUDACC__)
GSPLAT_INLINE float unit_interval(uint32_t x) { return float(x >> 8) * 5.9604644775390625e-8f; }
#endif

// Return a number in [0, 1) with 53 random bits.
GSPLAT_INLINE double unit_interval(uint32_t high, uint32_t low) {
  return (double(high >> 5) * 67108864.0 + double(low >> 6)) * 1.1102230246251565e-16;
}

}  // namespace GSPLAT_ISA
