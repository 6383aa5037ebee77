// Squared distance at which a ray passes a Gaussian, one ray per lane.
#pragma once

#include "constants.h"
#include "simd.h"
#include "world_blending.h"

namespace GSPLAT_ISA::world_blending {

using namespace gsplat::world_blending;

constexpr float kHalfLog2E = 0.72134752f;

// Return the squared distance in standard deviations. The offset of the ray's closest point is computed first; the
// difference of squares would cancel.
GSPLAT_INLINE vfloat squared_distance(const float* gaussian, const vfloat ray[kRayNumbers]) {
  vfloat origin[3], direction[3], along = vfloat{}, length = vfloat{};
  const vfloat away[3] = {ray[0] - gaussian[0], ray[1] - gaussian[1], ray[2] - gaussian[2]};
  for (int i = 0; i < 3; ++i) {
    const float* w = gaussian + 3 + 3 * i;
    origin[i] = w[0] * away[0] + w[1] * away[1] + w[2] * away[2];
    direction[i] = w[0] * ray[3] + w[1] * ray[4] + w[2] * ray[5];
    along += origin[i] * direction[i];
    length += direction[i] * direction[i];
  }
  const vfloat step = along / select(length > 0.0f, length, splat(1.0f));
  vfloat squared = vfloat{};
  for (int i = 0; i < 3; ++i) {
    const vfloat apart = origin[i] - direction[i] * step;
    squared += apart * apart;
  }
  return squared;
}

}  // namespace GSPLAT_ISA::world_blending
