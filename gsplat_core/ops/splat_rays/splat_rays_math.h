// Ray coefficients and normal of one Gaussian per lane, and their gradient (__init__.py states the formula).
#pragma once

#include "../covariance/covariance_math.h"
#include "simd.h"

namespace GSPLAT_ISA::splat_rays {

using covariance::Matrix3;
using covariance::UnitQuat;

constexpr float kReachSigmas = 3, kLeastScale = 1e-5f;

struct View {
  float w[3][3], t[3], fx, fy;
};
GSPLAT_INLINE View view_of(const float* viewmat, const float* K) {
  View v;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v.w[i][j] = viewmat[4 * i + j];
    v.t[i] = viewmat[4 * i + 3];
  }
  v.fx = K[0];
  v.fy = K[4];
  return v;
}

// Intermediate values of the forward and the backward pass. Gaussians behind the camera or with values that are not
// finite are replaced by a Gaussian at (0, 0, 1) in camera axes and are not `visible`.
struct State {
  vint visible;
  UnitQuat quat;
  Matrix3 axes;                  // columns: principal axes in camera axes
  vfloat c[3], inverse_z, p, r;  // centre in camera axes, x / z, y / z
  vfloat s[3], largest, u[3];    // scales, and their inverses times the largest one
  vfloat a[3], e[3], f[3];       // whitened derivatives by u and v in pixels, and whitened ray
  vfloat inverse_q, gx, gy, xx, xy, yy;
};

GSPLAT_INLINE State state_of(const View& view, const vfloat mean[3], const vfloat q[4], const vfloat scale[3]) {
  State s;
  const vfloat none = splat(0.0f), one = splat(1.0f);
  vfloat check = none;  // NaN if any value is not finite
  for (int k = 0; k < 3; ++k) check += 0.0f * mean[k] + 0.0f * scale[k];
  for (int k = 0; k < 4; ++k) check += 0.0f * q[k];
  vfloat c[3];
  for (int i = 0; i < 3; ++i) c[i] = view.w[i][0] * mean[0] + view.w[i][1] * mean[1] + view.w[i][2] * mean[2] + view.t[i];
  const vfloat smallest = min(scale[0], min(scale[1], scale[2]));
  s.visible = (check == 0.0f) & (c[2] > 0.0f) & (smallest > 0.0f) & covariance::normalise(q).valid;
  for (int i = 0; i < 3; ++i) {
    s.c[i] = select(s.visible, c[i], i == 2 ? one : none);
    s.s[i] = select(s.visible, scale[i], one);
  }
  const vfloat unit[4] = {select(s.visible, q[0], one), select(s.visible, q[1], none), select(s.visible, q[2], none),
                          select(s.visible, q[3], none)};
  s.quat = covariance::normalise(unit);
  const Matrix3 rotation = covariance::rotation_of(s.quat);
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      s.axes.m[i][k] = view.w[i][0] * rotation.m[0][k] + view.w[i][1] * rotation.m[1][k] + view.w[i][2] * rotation.m[2][k];
  s.inverse_z = 1.0f / s.c[2];
  s.p = s.c[0] * s.inverse_z;
  s.r = s.c[1] * s.inverse_z;
  s.largest = max(s.s[0], max(s.s[1], s.s[2]));
  vfloat square = none, af = none, ef = none, aa = none, ae = none, ee = none;
  for (int k = 0; k < 3; ++k) {
    s.u[k] = 1.0f / max(s.s[k] / s.largest, splat(kLeastScale));
    s.a[k] = s.axes.m[0][k] * s.u[k] / view.fx;
    s.e[k] = s.axes.m[1][k] * s.u[k] / view.fy;
    s.f[k] = (s.axes.m[0][k] * s.p + s.axes.m[1][k] * s.r + s.axes.m[2][k]) * s.u[k];
    square += s.f[k] * s.f[k];
    af += s.a[k] * s.f[k];
    ef += s.e[k] * s.f[k];
    aa += s.a[k] * s.a[k];
    ae += s.a[k] * s.e[k];
    ee += s.e[k] * s.e[k];
  }
  s.inverse_q = 1.0f / square;
  s.gx = af * s.inverse_q;
  s.gy = ef * s.inverse_q;
  s.xx = aa * s.inverse_q;
  s.xy = ae * s.inverse_q;
  s.yy = ee * s.inverse_q;
  return s;
}

// Select the shortest axis: chosen[k] is 0 except for the first shortest one, whose sign turns it towards the camera.
GSPLAT_INLINE void shortest_axis(const State& s, vfloat chosen[3]) {
  const vint first = (s.s[0] <= s.s[1]) & (s.s[0] <= s.s[2]), second = (s.s[1] < s.s[0]) & (s.s[1] <= s.s[2]);
  const vfloat none = splat(0.0f);
  for (int k = 0; k < 3; ++k) {
    const vfloat along = s.axes.m[0][k] * s.c[0] + s.axes.m[1][k] * s.c[1] + s.axes.m[2][k] * s.c[2];
    const vfloat sign = select(along > 0.0f, splat(-1.0f), splat(1.0f));
    chosen[k] = k == 0   ? select(first, sign, none)
                : k == 1 ? select(second, sign, none)
                         : select(first, none, select(second, none, sign));
  }
}

GSPLAT_INLINE void rays_of(const State& s, vfloat rays[10], vfloat normal[3]) {
  rays[0] = s.c[2];
  rays[1] = s.c[2] * s.gx;
  rays[2] = s.c[2] * s.gy;
  rays[3] = 2.0f * s.gx;
  rays[4] = 2.0f * s.gy;
  rays[5] = s.xx;
  rays[6] = 2.0f * s.xy;
  rays[7] = s.yy;
  rays[8] = kReachSigmas * s.largest;
  rays[9] = s.largest * s.largest * s.inverse_q;
  vfloat chosen[3];
  shortest_axis(s, chosen);
  for (int i = 0; i < 3; ++i) normal[i] = chosen[0] * s.axes.m[i][0] + chosen[1] * s.axes.m[i][1] + chosen[2] * s.axes.m[i][2];
}

// Propagate gradients to mean, rotation and scales. The coefficients that depend on u do not change with a common factor
// of u, so that `largest` in u needs no gradient.
GSPLAT_INLINE void rays_backward(const View& view, const State& s, const vfloat v[10], const vfloat v_normal[3], vfloat v_mean[3],
                                 vfloat v_quat[4], vfloat v_scale[3]) {
  const vfloat none = splat(0.0f);
  const vfloat v_gx = s.c[2] * v[1] + 2.0f * v[3], v_gy = s.c[2] * v[2] + 2.0f * v[4], v_xy = 2.0f * v[6];
  const vfloat v_q = -(s.gx * v_gx + s.gy * v_gy + s.xx * v[5] + s.xy * v_xy + s.yy * v[7]) * s.inverse_q;
  vfloat chosen[3], v_p = none, v_r = none;
  shortest_axis(s, chosen);
  vfloat equal[3], ties = none;
  for (int k = 0; k < 3; ++k) {
    equal[k] = select(s.s[k] >= s.largest, splat(1.0f), none);
    ties += equal[k];
  }
  Matrix3 v_axes;
  for (int k = 0; k < 3; ++k) {
    const vfloat v_a = (s.f[k] * v_gx + 2.0f * s.a[k] * v[5] + s.e[k] * v_xy) * s.inverse_q / view.fx;
    const vfloat v_e = (s.f[k] * v_gy + 2.0f * s.e[k] * v[7] + s.a[k] * v_xy) * s.inverse_q / view.fy;
    const vfloat v_f = (s.a[k] * v_gx + s.e[k] * v_gy) * s.inverse_q + 2.0f * s.f[k] * v_q;
    const vfloat by[3] = {v_a + v_f * s.p, v_e + v_f * s.r, v_f};
    vfloat v_u = none;
    for (int i = 0; i < 3; ++i) {
      v_u += s.axes.m[i][k] * by[i];
      v_axes.m[i][k] = s.u[k] * by[i] + chosen[k] * v_normal[i];
    }
    v_p += s.u[k] * s.axes.m[0][k] * v_f;
    v_r += s.u[k] * s.axes.m[1][k] * v_f;
    const vfloat of_ratio = select(s.s[k] > kLeastScale * s.largest, -(s.u[k] / s.s[k]) * v_u, none);
    v_scale[k] = select(s.visible, of_ratio + equal[k] * (kReachSigmas * v[8]) / ties, none);
  }
  const vfloat v_c[3] = {v_p * s.inverse_z, v_r * s.inverse_z,
                         v[0] + s.gx * v[1] + s.gy * v[2] - (s.p * v_p + s.r * v_r) * s.inverse_z};
  Matrix3 v_rotation;
  for (int j = 0; j < 3; ++j) {
    v_mean[j] = select(s.visible, view.w[0][j] * v_c[0] + view.w[1][j] * v_c[1] + view.w[2][j] * v_c[2], none);
    for (int k = 0; k < 3; ++k)
      v_rotation.m[j][k] = view.w[0][j] * v_axes.m[0][k] + view.w[1][j] * v_axes.m[1][k] + view.w[2][j] * v_axes.m[2][k];
  }
  covariance::rotation_backward(s.quat, v_rotation, v_quat);
  for (int k = 0; k < 4; ++k) v_quat[k] = select(s.visible, v_quat[k], none);
}

}  // namespace GSPLAT_ISA::splat_rays
