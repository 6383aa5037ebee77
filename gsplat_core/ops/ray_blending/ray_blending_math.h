// Depth of a splat along a ray, and the conversion of a splat's sums over pixels to gradients.
#pragma once

#include "ray_blending.h"
#include "simd.h"

namespace GSPLAT_ISA::ray_blending {

using namespace gsplat::ray_blending;

// Numerator and denominator of the depth at the offset (dx, dy) from the splat's mean.
struct Fraction {
  vfloat numerator, denominator;
};
GSPLAT_INLINE Fraction fraction_at(const float* ray, vfloat dx, vfloat dy) {
  const vfloat across = ray[kMxx] * dx + (ray[kMxy] * dy + ray[kLx]);
  const vfloat down = ray[kMyy] * dy + ray[kLy];
  return {ray[kNx] * dx + (ray[kNy] * dy + ray[kZ]), max(across * dx + (down * dy + 1.0f), splat(kLeastDenominator))};
}

// Convert the sums over pixels of a splat (moments, then sums of its ray) to its gradients.
GSPLAT_INLINE void splat_gradients(const float* sums, const float* conic, const float* ray, float opacity, float* v_mean2d,
                                   float* v_conic, float* v_opacity, float* v_ray) {
  const float *m = sums, *r = sums + kMoments;
  v_mean2d[0] = conic[0] * m[1] + conic[1] * m[2] - (ray[kNx] * r[0] + ray[kLx] * r[3] + 2 * ray[kMxx] * r[4] + ray[kMxy] * r[5]);
  v_mean2d[1] = conic[1] * m[1] + conic[2] * m[2] - (ray[kNy] * r[0] + ray[kLy] * r[3] + ray[kMxy] * r[4] + 2 * ray[kMyy] * r[5]);
  v_conic[0] = -0.5f * m[3];
  v_conic[1] = -m[4];
  v_conic[2] = -0.5f * m[5];
  *v_opacity = m[0] / opacity;
  v_ray[kZ] = r[0] + r[9];
  v_ray[kNx] = r[1];
  v_ray[kNy] = r[2];
  v_ray[kLx] = r[4];
  v_ray[kLy] = r[5];
  v_ray[kMxx] = r[6];
  v_ray[kMxy] = r[7];
  v_ray[kMyy] = r[8];
  v_ray[kReach] = r[10];
  v_ray[kVariance] = 0;
}

}  // namespace GSPLAT_ISA::ray_blending
