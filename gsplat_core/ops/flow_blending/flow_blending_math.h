// Depth of a splat on a ray, and the pixel to which the splat carries the surface there; a vector of pixels at a time.
#pragma once

#include "../ray_blending/ray_blending_math.h"
#include "flow_blending.h"
#include "simd.h"

namespace GSPLAT_ISA::flow_blending {

using namespace gsplat::flow_blending;

// Return the depth of a splat's highest density on the ray that passes (dx, dy) pixels from its mean, limited to the
// splat's extent.
GSPLAT_INLINE vfloat depth_on_ray(const float* ray, vfloat dx, vfloat dy) {
  const ray_blending::Fraction f = ray_blending::fraction_at(ray, dx, dy);
  const vfloat t = f.numerator / f.denominator, reach = splat(ray[ray_blending::kReach]), z = splat(ray[ray_blending::kZ]);
  return max(min(t, z + reach), z - reach);
}

// Offset of a pixel from a splat's mean, and its ray (x, y, 1) in the first camera.
struct Ray {
  vfloat dx, dy, x, y;
};

// A point moved by a splat, and its distance in pixels from the pixel of its ray.
struct Moved {
  vfloat depth_on_ray;
  vfloat p[3];
  vint in_front;      // of the second camera
  vfloat reciprocal;  // 1 / p_z where the point is in front
  vfloat flow_x, flow_y;
};
GSPLAT_INLINE Moved moved(const float* numbers, const float* plane, const Pinhole& before, const Pinhole& after, const Ray& ray) {
  Moved m;
  const vfloat t = m.depth_on_ray = depth_on_ray(numbers, ray.dx, ray.dy);
  for (int k = 0; k < 3; ++k) {
    const float* const row = plane + 3 + 3 * k;
    m.p[k] = plane[k] + t * (ray.x * row[0] + ray.y * row[1] + row[2]);
  }
  m.in_front = m.p[2] > kNearest;
  m.reciprocal = 1.0f / select(m.in_front, m.p[2], splat(1.0f));
  m.flow_x = (m.p[0] * m.reciprocal * after.fx - ray.x * before.fx) + (after.cx - before.cx);
  m.flow_y = (m.p[1] * m.reciprocal * after.fy - ray.y * before.fy) + (after.cy - before.cy);
  return m;
}

// Return dL/dp from the gradient of the blended channels and the splat's weight, which is 0 behind the camera.
GSPLAT_INLINE void moved_backward(const Moved& m, const Pinhole& after, vfloat weight, const vfloat* v_out, vfloat* v_p) {
  const vfloat scaled = weight * m.reciprocal;
  v_p[0] = scaled * v_out[0] * after.fx;
  v_p[1] = scaled * v_out[1] * after.fy;
  v_p[2] = weight * v_out[2] - (v_p[0] * m.p[0] + v_p[1] * m.p[1]) * m.reciprocal;
}

}  // namespace GSPLAT_ISA::flow_blending
