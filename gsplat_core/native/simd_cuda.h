// CUDA version of simd.h: a thread is a lane, so the CPU and the GPU share the headers with an op's maths.
#pragma once

#include <cstdint>

#define GSPLAT_INLINE static __device__ __forceinline__
#define GSPLAT_METHOD __device__ __forceinline__

namespace GSPLAT_ISA {

constexpr int kLanes = 1;

typedef float vfloat;
typedef int32_t vint;  // result of a comparison: non-zero where true

GSPLAT_INLINE vfloat splat(float x) { return x; }
GSPLAT_INLINE vint splat_int(int32_t x) { return x; }
GSPLAT_INLINE vfloat select(vint mask, vfloat a, vfloat b) { return mask ? a : b; }
// Not fminf and fmaxf, so that NaN is handled as on the CPU.
GSPLAT_INLINE vfloat min(vfloat a, vfloat b) { return a < b ? a : b; }
GSPLAT_INLINE vfloat max(vfloat a, vfloat b) { return a > b ? a : b; }
GSPLAT_INLINE vfloat fma(vfloat a, vfloat b, vfloat c) { return ::fmaf(a, b, c); }
GSPLAT_INLINE vfloat reciprocal(vfloat x) { return 1.0f / x; }
GSPLAT_INLINE vfloat sqrt(vfloat x) { return ::sqrtf(x); }
GSPLAT_INLINE vfloat log2(vfloat x) { return ::log2f(x); }
GSPLAT_INLINE vfloat ceil(vfloat x) { return ::ceilf(x); }
GSPLAT_INLINE vfloat atan2(vfloat y, vfloat x) { return ::atan2f(y, x); }

}  // namespace GSPLAT_ISA
