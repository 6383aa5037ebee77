// Loads and stores of the first few lanes of a vector, and the square root. Only kernel files (*_cpu.cpp) include this.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA {

// Return -1 in the first `count` lanes, 0 in the others.
GSPLAT_INLINE vint first_lanes(int64_t count) { return ramp() < float(count); }

// Load the first `count` floats at p and zero the other lanes, without reading past them.
GSPLAT_INLINE vfloat load_first(const float* p, int64_t count) {
#if defined(__AVX512F__)
  return (vfloat)_mm512_maskz_loadu_ps(__mmask16(count >= 16 ? 0xffff : (1u << count) - 1), p);
#elif defined(__AVX2__)
  return (vfloat)_mm256_maskload_ps(p, (__m256i)first_lanes(count));
#else
  vfloat v = {};
  for (int i = 0; i < kLanes; ++i)
    if (i < count) v[i] = p[i];
  return v;
#endif
}

GSPLAT_INLINE void store_first(float* p, vfloat v, int64_t count) {
#if defined(__AVX512F__)
  _mm512_mask_storeu_ps(p, __mmask16(count >= 16 ? 0xffff : (1u << count) - 1), (__m512)v);
#elif defined(__AVX2__)
  _mm256_maskstore_ps(p, (__m256i)first_lanes(count), (__m256)v);
#else
  for (int i = 0; i < kLanes; ++i)
    if (i < count) p[i] = v[i];
#endif
}

GSPLAT_INLINE vfloat square_root(vfloat v) {
#if defined(__AVX512F__)
  return (vfloat)_mm512_sqrt_ps((__m512)v);
#elif defined(__AVX2__)
  return (vfloat)_mm256_sqrt_ps((__m256)v);
#elif defined(__SSE2__)
  return (vfloat)_mm_sqrt_ps((__m128)v);
#else
  for (int i = 0; i < kLanes; ++i) v[i] = __builtin_sqrtf(v[i]);
  return v;
#endif
}

}  // namespace GSPLAT_ISA
