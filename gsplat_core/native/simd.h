// Float vectors for the CPU kernels: GCC/Clang vector extensions with the width of the instruction set compiled for.
//
// Kernel files (*_cpu.cpp) include this header. All functions are static in the set's namespace, and kernel files
// include no standard header with inline code: the linker could pick an AVX-512 copy of a shared inline function, which
// crashes on older processors. Headers with an op's maths include it too. CUDA compiles them with simd_cuda.h, where a
// vector is one float per thread.
#pragma once

#if defined(__CUDACC__)
#include "simd_cuda.h"
#else

#include <cstdint>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define GSPLAT_INLINE static inline __attribute__((always_inline))
#define GSPLAT_METHOD inline __attribute__((always_inline))

namespace GSPLAT_ISA {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif

typedef float vfloat __attribute__((vector_size(kLanes * 4)));
typedef int32_t vint __attribute__((vector_size(kLanes * 4)));  // also the result of a comparison: all bits set where true

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

// Return one bit per lane of a comparison result.
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

// 2^x for x in [-126, 127]: degree-5 polynomial on [-0.5, 0.5], relative error below 4e-6 (largest at the ends of the interval).
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

// a * b + c, rounded once if the instruction set has FMA. Two kernels that compute the same expression then agree
// bitwise.
GSPLAT_INLINE vfloat fma(vfloat a, vfloat b, vfloat c) {
#if defined(__AVX512F__)
  return (vfloat)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif defined(__FMA__)
  return (vfloat)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}

GSPLAT_INLINE vfloat sqrt(vfloat x) {
#if defined(__AVX512F__)
  return (vfloat)_mm512_sqrt_ps((__m512)x);
#elif defined(__AVX2__)
  return (vfloat)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE2__)
  return (vfloat)_mm_sqrt_ps((__m128)x);
#else
  for (int i = 0; i < kLanes; ++i) x[i] = __builtin_sqrtf(x[i]);
  return x;
#endif
}

// 1 / x with a relative error of about 2e-7, for x in [1e-30, 1e30].
GSPLAT_INLINE vfloat reciprocal(vfloat x) {
#if defined(__AVX512F__)
  const vfloat r = (vfloat)_mm512_rcp14_ps((__m512)x);
  return fma(r, fma(-x, r, splat(1.0f)), r);
#else
  return 1.0f / x;
#endif
}

// 1 / sqrt(x) with a relative error of about 2e-7, for x in [1e-30, 1e30].
GSPLAT_INLINE vfloat inverse_root(vfloat x) {
#if defined(__AVX512F__)
  const vfloat r = (vfloat)_mm512_rsqrt14_ps((__m512)x);
  return r * fma(-0.5f * x * r, r, splat(1.5f));
#else
  return 1.0f / sqrt(x);
#endif
}

// log2(x) for normal x > 0: atanh series of the mantissa around 1, absolute error below 3e-7.
GSPLAT_INLINE vfloat log2(vfloat x) {
  const vint shifted = (vint)x - 0x3f3504f3;  // the mantissa ends in [sqrt(1/2), sqrt(2))
  const vint exponent = shifted >> 23;
  const vfloat m = (vfloat)((vint)x - (exponent << 23));
  const vfloat t = (m - 1.0f) / (m + 1.0f), t2 = t * t;
  vfloat p = splat(0.32059890f);  // 2 / (9 ln 2); then the coefficients with divisors 7, 5, 3, 1
  p = fma(p, t2, splat(0.41219859f));
  p = fma(p, t2, splat(0.57707802f));
  p = fma(p, t2, splat(0.96179669f));
  p = fma(p, t2, splat(2.88539008f));
  return fma(p, t, __builtin_convertvector(exponent, vfloat));
}

GSPLAT_INLINE vint to_int(vfloat x) { return __builtin_convertvector(x, vint); }
// Round towards zero, for |x| < 2^31.
GSPLAT_INLINE vfloat truncate(vfloat x) { return __builtin_convertvector(to_int(x), vfloat); }

// A lane mask. With AVX-512 it is a mask register, because GCC converts vector comparisons to vectors and back.
#if defined(__AVX512F__)
typedef __mmask16 vmask;
GSPLAT_INLINE vmask at_least(vfloat a, vfloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
GSPLAT_INLINE vmask above(vfloat a, vfloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
GSPLAT_INLINE vmask at_least(vint a, vint b) { return _mm512_cmpge_epi32_mask((__m512i)a, (__m512i)b); }
GSPLAT_INLINE vfloat where(vmask m, vfloat a, vfloat b) { return (vfloat)_mm512_mask_mov_ps((__m512)b, m, (__m512)a); }
GSPLAT_INLINE vint where(vmask m, vint a, vint b) { return (vint)_mm512_mask_mov_epi32((__m512i)b, m, (__m512i)a); }
GSPLAT_INLINE vfloat zero_unless(vmask m, vfloat a) { return (vfloat)_mm512_maskz_mov_ps(m, (__m512)a); }
GSPLAT_INLINE uint32_t lanes_of(vmask m) { return m; }
GSPLAT_INLINE vmask no_lanes() { return 0; }
GSPLAT_INLINE vint or_where(vmask m, vint a, int32_t bit) {
  return (vint)_mm512_mask_or_epi32((__m512i)a, m, (__m512i)a, _mm512_set1_epi32(bit));
}
GSPLAT_INLINE vfloat smaller(vfloat a, vfloat b) { return (vfloat)_mm512_min_ps((__m512)a, (__m512)b); }
GSPLAT_INLINE vfloat larger(vfloat a, vfloat b) { return (vfloat)_mm512_max_ps((__m512)a, (__m512)b); }
#else
typedef vint vmask;
GSPLAT_INLINE vmask at_least(vfloat a, vfloat b) { return a >= b; }
GSPLAT_INLINE vmask above(vfloat a, vfloat b) { return a > b; }
GSPLAT_INLINE vmask at_least(vint a, vint b) { return a >= b; }
#if defined(__AVX2__)
GSPLAT_INLINE vfloat where(vmask m, vfloat a, vfloat b) { return (vfloat)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m); }
GSPLAT_INLINE vint where(vmask m, vint a, vint b) { return (vint)_mm256_blendv_epi8((__m256i)b, (__m256i)a, (__m256i)m); }
GSPLAT_INLINE vfloat smaller(vfloat a, vfloat b) { return (vfloat)_mm256_min_ps((__m256)a, (__m256)b); }
GSPLAT_INLINE vfloat larger(vfloat a, vfloat b) { return (vfloat)_mm256_max_ps((__m256)a, (__m256)b); }
#else
GSPLAT_INLINE vfloat where(vmask m, vfloat a, vfloat b) { return (vfloat)((m & (vint)a) | (~m & (vint)b)); }
GSPLAT_INLINE vint where(vmask m, vint a, vint b) { return (m & a) | (~m & b); }
#if defined(__SSE2__)
GSPLAT_INLINE vfloat smaller(vfloat a, vfloat b) { return (vfloat)_mm_min_ps((__m128)a, (__m128)b); }
GSPLAT_INLINE vfloat larger(vfloat a, vfloat b) { return (vfloat)_mm_max_ps((__m128)a, (__m128)b); }
#else
GSPLAT_INLINE vfloat smaller(vfloat a, vfloat b) { return where(a < b, a, b); }
GSPLAT_INLINE vfloat larger(vfloat a, vfloat b) { return where(a > b, a, b); }
#endif
#endif
GSPLAT_INLINE vfloat zero_unless(vmask m, vfloat a) { return (vfloat)(m & (vint)a); }
GSPLAT_INLINE uint32_t lanes_of(vmask m) { return bits(m); }
GSPLAT_INLINE vmask no_lanes() { return vint{}; }
GSPLAT_INLINE vint or_where(vmask m, vint a, int32_t bit) { return a | (m & bit); }
#endif

// Valid for any float.
GSPLAT_INLINE vfloat ceil(vfloat x) {
  for (int i = 0; i < kLanes; ++i) x[i] = __builtin_ceilf(x[i]);
  return x;
}
GSPLAT_INLINE vfloat atan2(vfloat y, vfloat x) {
  vfloat angle;
  for (int i = 0; i < kLanes; ++i) angle[i] = __builtin_atan2f(y[i], x[i]);
  return angle;
}

GSPLAT_INLINE vfloat ceiling(vfloat x) {
  const vfloat below = truncate(x);
  return below + where(above(x, below), splat(1.0f), vfloat{});
}

// out[i] = sum of the lanes of v[i], in a fixed order of additions. Vectors are reduced together where the set has the
// shuffles.
template <int kCount>
GSPLAT_INLINE void sums(const vfloat* v, float* out) {
#if defined(__AVX512F__)
  for (int first = 0; first < kCount; first += 16) {
    const auto at = [&](int slot) {  // slot 4k + l is stored in lane 4l + k
      const int i = first + 4 * (slot & 3) + (slot >> 2);
      return i < kCount ? (__m512)v[i] : _mm512_setzero_ps();
    };
    const auto halves = [&](int slot) {
      const __m512 a = at(slot), b = at(slot + 1);
      return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xee));
    };
    const auto quarters = [&](int slot) {
      const __m512 a = halves(slot), b = halves(slot + 2);
      return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd));
    };
    const auto eighths = [&](int slot) {
      const __m512 a = quarters(slot), b = quarters(slot + 4);
      return _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    };
    const __m512 a = eighths(0), b = eighths(8);
    const __m512 total = _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x44), _mm512_shuffle_ps(a, b, 0xee));
    const int left = kCount - first;
    _mm512_mask_storeu_ps(out + first, __mmask16(left >= 16 ? 0xffff : (1 << left) - 1), total);
  }
#elif defined(__AVX2__)
  for (int first = 0; first < kCount; first += 4) {
    const auto at = [&](int i) { return i < kCount ? (__m256)v[i] : _mm256_setzero_ps(); };
    const __m256 both = _mm256_hadd_ps(_mm256_hadd_ps(at(first), at(first + 1)), _mm256_hadd_ps(at(first + 2), at(first + 3)));
    const __m128 total = _mm_add_ps(_mm256_castps256_ps128(both), _mm256_extractf128_ps(both, 1));
    float four[4];
    _mm_storeu_ps(four, total);
    for (int i = 0; i < 4 && first + i < kCount; ++i) out[first + i] = four[i];
  }
#else
  for (int i = 0; i < kCount; ++i) out[i] = sum(v[i]);
#endif
}

}  // namespace GSPLAT_ISA
#endif
