// Noise on the position of one Gaussian per lane (Kheradmand et al. 2024, equation 10).
#pragma once

#include "../covariance/covariance_math.h"
#include "simd.h"

namespace GSPLAT_ISA::densification {

constexpr float kLog2E = 1.44269504f;
constexpr float kMostExponent = 87.0f;  // e^87 is a finite float

// exp(x) for x up to kMostExponent, at least the smallest normal float. Not for NaN.
GSPLAT_INLINE vfloat natural_exp(vfloat x) { return exp2(max(min(x, splat(kMostExponent)) * kLog2E, splat(-126.0f))); }

GSPLAT_INLINE vfloat sigmoid(vfloat x) { return 1.0f / (1.0f + natural_exp(-x)); }

// Add R S S R^T noise * scale * share to the mean, with a share that is 1/2 at `opacity_at_half`. A NaN, a result that is not
// finite, and a rotation of length zero leave the mean as it is.
GSPLAT_INLINE void diffused(vfloat mean[3], const vfloat quat[4], const vfloat log_scales[3], vfloat logit, const vfloat noise[3],
                            float scale, float opacity_at_half, float steepness) {
  const covariance::UnitQuat unit = covariance::normalise(quat);
  const covariance::Matrix3 r = covariance::rotation_of(unit);
  const vfloat share = scale * sigmoid(-steepness * (sigmoid(logit) - opacity_at_half));
  vint valid = unit.valid & (logit == logit);
  vfloat along[3];
  for (int k = 0; k < 3; ++k) {
    valid &= 2.0f * log_scales[k] <= kMostExponent;
    const vfloat variance = natural_exp(2.0f * log_scales[k]);
    along[k] = share * variance * (r.m[0][k] * noise[0] + r.m[1][k] * noise[1] + r.m[2][k] * noise[2]);
  }
  vfloat moved[3];
  for (int i = 0; i < 3; ++i) {
    moved[i] = mean[i] + (r.m[i][0] * along[0] + r.m[i][1] * along[1] + r.m[i][2] * along[2]);
    valid &= moved[i] - moved[i] == 0.0f;
  }
  for (int i = 0; i < 3; ++i) mean[i] = select(valid, moved[i], mean[i]);
}

}  // namespace GSPLAT_ISA::densification
