// The three camera models, one Gaussian per lane: image point and Jacobian of a camera-space point, and their
// gradients.
#pragma once

#include "constants.h"
#include "projection.h"
#include "simd.h"

namespace GSPLAT_ISA::projection {

using namespace gsplat::projection;

struct Point3 {
  vfloat x, y, z;
};

struct ImagePoint {
  vfloat u, v;
  vfloat j[2][3];  // d(u, v) / d(x, y, z)
};

struct Intrinsics {
  float fx, fy, cx, cy;
  float slope_min[2], slope_max[2];  // limits of the slope in the pinhole Jacobian: 0.3 half fields of view beyond the border
};

GSPLAT_INLINE Intrinsics intrinsics_of(const float* k, float width, float height) {
  const float fx = k[0], fy = k[4], cx = k[2], cy = k[5];
  const float margin_x = gsplat::kFieldOfViewMargin * 0.5f * width / fx,
              margin_y = gsplat::kFieldOfViewMargin * 0.5f * height / fy;
  return {fx,
          fy,
          cx,
          cy,
          {-(cx / fx + margin_x), -(cy / fy + margin_y)},
          {(width - cx) / fx + margin_x, (height - cy) / fy + margin_y}};
}

template <CameraModel model>
struct Projector;

template <>
struct Projector<kPinhole> {
  static GSPLAT_METHOD ImagePoint forward(const Intrinsics& k, const Point3& p) {
    const vfloat r = 1.0f / p.z;
    const vfloat tx = p.x * r, ty = p.y * r;
    const vfloat sx = min(max(tx, splat(k.slope_min[0])), splat(k.slope_max[0]));
    const vfloat sy = min(max(ty, splat(k.slope_min[1])), splat(k.slope_max[1]));
    return {k.fx * tx + k.cx, k.fy * ty + k.cy, {{k.fx * r, vfloat{}, -k.fx * sx * r}, {vfloat{}, k.fy * r, -k.fy * sy * r}}};
  }

  static GSPLAT_METHOD Point3 backward(const Intrinsics& k, const Point3& p, vfloat v_u, vfloat v_v, const vfloat v_j[2][3]) {
    const vfloat r = 1.0f / p.z;
    const vfloat t[2] = {p.x * r, p.y * r}, v_image[2] = {v_u, v_v};
    const float f[2] = {k.fx, k.fy};
    vfloat v[2], v_z = {};
    for (int a = 0; a < 2; ++a) {
      const vfloat s = min(max(t[a], splat(k.slope_min[a])), splat(k.slope_max[a]));
      const vint free = (t[a] > k.slope_min[a]) & (t[a] < k.slope_max[a]);
      // gradient through the slope: of the image point f t, and of the Jacobian's last column -f s / z where it is not
      // clamped
      const vfloat v_t = f[a] * v_image[a] - select(free, f[a] * r * v_j[a][2], vfloat{});
      v[a] = v_t * r;
      v_z -= v_t * t[a] * r;
      // gradient through 1 / z
      v_z += (f[a] * r * r) * (s * v_j[a][2] - v_j[a][a]);
    }
    return {v[0], v[1], v_z};
  }
};

template <>
struct Projector<kOrtho> {
  static GSPLAT_METHOD ImagePoint forward(const Intrinsics& k, const Point3& p) {
    return {k.fx * p.x + k.cx, k.fy * p.y + k.cy, {{splat(k.fx), vfloat{}, vfloat{}}, {vfloat{}, splat(k.fy), vfloat{}}}};
  }

  static GSPLAT_METHOD Point3 backward(const Intrinsics& k, const Point3& p, vfloat v_u, vfloat v_v, const vfloat v_j[2][3]) {
    return {k.fx * v_u, k.fy * v_v, vfloat{}};
  }
};

// Equidistant fisheye: the image radius is f theta. With r = |(x, y)|, w = 1 / (r^2 + z^2), s = theta / r and q = (z w
// - s) / r^2: ds/dx = q x, ds/dz = -w, dq/dx = e x with e = -(2 z w^2 + 3 q) / r^2, dq/dz = 2 w^2.
template <>
struct Projector<kFisheye> {
  struct Terms {
    vfloat s, q, e, w;
  };

  static GSPLAT_METHOD Terms terms(const Point3& p) {
    const vfloat r2 = p.x * p.x + p.y * p.y, r = sqrt(r2), w = 1.0f / (r2 + p.z * p.z);
    const vfloat s = atan2(r, p.z) / r, q = (p.z * w - s) / r2, e = -(2 * p.z * w * w + 3 * q) / r2;
    // Near the axis these quotients suffer from cancellation, so their series in (r / z)^2 are used.
    const vfloat inv = 1.0f / p.z, t = r2 * inv * inv, inv3 = inv * inv * inv;
    const vfloat s_axis =
        inv * (1 + t * (-1.f / 3 + t * (1.f / 5 + t * (-1.f / 7 + t * (1.f / 9 + t * (-1.f / 11 + t * (1.f / 13)))))));
    const vfloat q_axis = inv3 * (-2.f / 3 + t * (4.f / 5 + t * (-6.f / 7 + t * (8.f / 9 + t * (-10.f / 11 + t * (12.f / 13))))));
    const vfloat e_axis = inv3 * inv * inv * (8.f / 5 + t * (-24.f / 7 + t * (16.f / 3 + t * (-80.f / 11 + t * (120.f / 13)))));
    const vint axis = (t < 0.0625f) & (p.z > 0);
    return {select(axis, s_axis, s), select(axis, q_axis, q), select(axis, e_axis, e), w};
  }

  static GSPLAT_METHOD ImagePoint forward(const Intrinsics& k, const Point3& p) {
    const Terms t = terms(p);
    const vfloat xy = t.q * p.x * p.y;
    return {k.fx * p.x * t.s + k.cx,
            k.fy * p.y * t.s + k.cy,
            {{k.fx * (t.s + t.q * p.x * p.x), k.fx * xy, -k.fx * p.x * t.w},
             {k.fy * xy, k.fy * (t.s + t.q * p.y * p.y), -k.fy * p.y * t.w}}};
  }

  static GSPLAT_METHOD Point3 backward(const Intrinsics& k, const Point3& p, vfloat v_u, vfloat v_v, const vfloat v_j[2][3]) {
    const Terms t = terms(p);
    const vfloat a0 = k.fx * v_j[0][0], a1 = k.fx * v_j[0][1], a2 = k.fx * v_j[0][2];
    const vfloat b0 = k.fy * v_j[1][0], b1 = k.fy * v_j[1][1], b2 = k.fy * v_j[1][2];
    const vfloat gu = k.fx * v_u, gv = k.fy * v_v, cross = a1 + b0;
    const vfloat v_s = gu * p.x + gv * p.y + a0 + b1;
    const vfloat v_q = a0 * p.x * p.x + cross * p.x * p.y + b1 * p.y * p.y;
    const vfloat v_w = -(a2 * p.x + b2 * p.y);
    const vfloat radial = v_s * t.q + v_q * t.e - 2 * v_w * t.w * t.w;  // times x or y: gradient through s, q and w
    return {gu * t.s + t.q * (2 * a0 * p.x + cross * p.y) - a2 * t.w + radial * p.x,
            gv * t.s + t.q * (2 * b1 * p.y + cross * p.x) - b2 * t.w + radial * p.y,
            -v_s * t.w + 2 * t.w * t.w * (v_q - v_w * p.z)};
  }
};

}  // namespace GSPLAT_ISA::projection
