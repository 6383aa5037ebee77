// Response of a Gaussian along rays and its derivatives, one ray per lane; shared by the CPU and CUDA kernels.
#pragma once

#include "constants.h"
#include "simd.h"
#include "world_blending.h"

namespace GSPLAT_ISA::world_blending {

using namespace gsplat::world_blending;

constexpr float kHalfLog2E = 0.72134752f;

// Closest points of rays to a Gaussian. The order of operations is explicit, so that the forward and the backward pass
// compute identical bits.
struct Passing {
  vfloat away[3];   // from the centre to the ray's origin
  vfloat step;      // from the origin to the closest point, in lengths of the direction
  vfloat apart[3];  // offset of the closest point from the centre in standard deviations
  vfloat squared;   // of `apart`
};

// The offset of the closest point is computed first; the difference of squares would cancel.
GSPLAT_INLINE Passing passing(const float* gaussian, const vfloat ray[kRayNumbers]) {
  Passing p;
  vfloat origin[3], direction[3], along = vfloat{}, length = vfloat{};
  for (int i = 0; i < 3; ++i) p.away[i] = ray[i] - gaussian[i];
  for (int i = 0; i < 3; ++i) {
    const float* w = gaussian + 3 + 3 * i;
    origin[i] = fma(splat(w[2]), p.away[2], fma(splat(w[1]), p.away[1], w[0] * p.away[0]));
    direction[i] = fma(splat(w[2]), ray[5], fma(splat(w[1]), ray[4], w[0] * ray[3]));
    along = fma(origin[i], direction[i], along);
    length = fma(direction[i], direction[i], length);
  }
  p.step = along / select(length > 0.0f, length, splat(1.0f));
  p.squared = vfloat{};
  for (int i = 0; i < 3; ++i) {
    p.apart[i] = fma(-direction[i], p.step, origin[i]);
    p.squared = fma(p.apart[i], p.apart[i], p.squared);
  }
  return p;
}

// log2 of the response; a distance that is no number gives the smallest one.
GSPLAT_INLINE vfloat log2_response(vfloat squared) { return max(-kHalfLog2E * squared, splat(-126.0f)); }

// Add the terms of pixels to the first kMoments sums of a Gaussian and to the gradients of their rays. `s` is alpha
// dL/dalpha where alpha follows from the response, else 0.
GSPLAT_INLINE void add_moments(const float* gaussian, const Passing& p, const vfloat ray[kRayNumbers], vfloat s, vfloat* sum,
                               vfloat* v_ray) {
  vfloat closest[3], by_offset[3] = {};
  for (int j = 0; j < 3; ++j) closest[j] = fma(-p.step, ray[3 + j], p.away[j]);
  sum[0] = sum[0] + s;
  for (int i = 0; i < 3; ++i) {
    const vfloat q = -s * p.apart[i];
    sum[1 + i] = sum[1 + i] + q;
    for (int j = 0; j < 3; ++j) {
      sum[4 + 3 * i + j] = fma(q, closest[j], sum[4 + 3 * i + j]);
      by_offset[j] = fma(q, splat(gaussian[3 + 3 * i + j]), by_offset[j]);
    }
  }
  for (int j = 0; j < 3; ++j) {
    v_ray[j] = v_ray[j] + by_offset[j];
    v_ray[3 + j] = fma(-p.step, by_offset[j], v_ray[3 + j]);
  }
}

// Convert the sums of a Gaussian to its gradients. Sums of 0 give 0, whatever the Gaussian's numbers are.
GSPLAT_INLINE void gaussian_gradients(const float* sums, const float* gaussian, float opacity, float* v_gaussian,
                                      float* v_opacity) {
  for (int j = 0; j < 3; ++j) {
    float v = 0;
    for (int i = 0; i < 3; ++i) v -= sums[1 + i] != 0 ? sums[1 + i] * gaussian[3 + 3 * i + j] : 0;
    v_gaussian[j] = v;
  }
  for (int k = 0; k < 9; ++k) v_gaussian[3 + k] = sums[4 + k];
  *v_opacity = sums[0] != 0 ? sums[0] / opacity : 0;
}

}  // namespace GSPLAT_ISA::world_blending
