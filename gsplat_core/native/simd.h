// Small vectors of floats for the CPU kernels: GCC/Clang vector extensions, width chosen by the instruction set compiled for.
//
// Only kernel files (*_cpu.cpp) include this. Everything is static inside the per-set namespace, and kernel files include no
// standard header with inline code: a shared inline function compiled with AVX-512 would crash older processors.
#pragma once

#include <cstdint>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define GSPLAT_INLINE static inline __attribute__((always_inline))

namespace GSPLAT_ISA {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float vfloat __attribute__((vector_size(kLanes * 4)));
typedef int32_t vint __attribute__((vector_size(kLanes * 4)));  // also the type of a comparison: all ones where true

GSPLAT_INLINE vfloat splat(float x) { return x - vfloat{}; }
GSPLAT_INLINE vint splat_int(int32_t x) { return x - vint{}; }

GSPLAT_INLINE vfloat load(const float* p) {
  vfloat v;
  __builtin_memcpy(&v, p, sizeof(v));
  return v;
}
GSPLAT_INLINE void store(float* p, vfloat v) { __builtin_memcpy(p, &v, sizeof(v)); }

// 0, 1, 2, ... kLanes-1
GSPLAT_INLINE vfloat ramp() {
  vfloat v;
  for (int i = 0; i < kLanes; ++i) v[i] = float(i);
  return v;
}

GSPLAT_INLINE vfloat select(vint mask, vfloat a, vfloat b) { return mask ? a : b; }
GSPLAT_INLINE vfloat min(vfloat a, vfloat b) { return a < b ? a : b; }
GSPLAT_INLINE vfloat max(vfloat a, vfloat b) { return a > b ? a : b; }

// One bit per lane of a comparison.
GSPLAT_INLINE uint32_t bits(vint mask) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
  return uint32_t(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
  return uint32_t(_mm_movemask_ps((__m128)mask));
#else
  uint32_t r = 0;
  for (int i = 0; i < kLanes; ++i) r |= uint32_t(mask[i] & 1) << i;
  return r;
#endif
}

GSPLAT_INLINE float sum(vfloat v) {
#if defined(__AVX512F__)
  return _mm512_reduce_add_ps((__m512)v);
#else
  float s = 0;
  for (int i = 0; i < kLanes; ++i) s += v[i];
  return s;
#endif
}

// 2^x for x in [-126, 127]: degree-5 minimax polynomial on [-0.5, 0.5], relative error below 3e-7.
GSPLAT_INLINE vfloat exp2(vfloat x) {
  const vfloat shifted = x + 12582912.0f;  // 1.5 * 2^23 rounds to the nearest integer
  const vfloat f = x - (shifted - 12582912.0f);
  vfloat p = 1.33951852e-3f + vfloat{};
  p = p * f + 9.61884427e-3f;
  p = p * f + 5.55034143e-2f;
  p = p * f + 2.40226507e-1f;
  p = p * f + 6.93147182e-1f;
  p = p * f + 1.0f;
  return (vfloat)((vint)p + ((vint)shifted << 23));
}

}  // namespace GSPLAT_ISA
