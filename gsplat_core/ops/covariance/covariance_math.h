// Covariance from rotation and scale, and its gradient, one Gaussian per lane (Kerbl et al. 2023, equation 6).
#pragma once

#include "simd.h"

namespace GSPLAT_ISA::covariance {

struct Matrix3 {
  vfloat m[3][3];
};

// xx, xy, xz, yy, yz, zz
struct Symmetric3 {
  vfloat v[6];
};

struct UnitQuat {
  vfloat w, x, y, z, inverse_norm;
  vint valid;  // the quaternion's length is neither zero nor beyond float's range
};

GSPLAT_INLINE UnitQuat normalise(const vfloat q[4]) {
  const vfloat squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  const vfloat inverse = 1.0f / sqrt(squared);
  return {q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse, inverse, (squared > 1e-36f) & (squared < 1e36f)};
}

GSPLAT_INLINE Matrix3 rotation_of(const UnitQuat& q) {
  const vfloat xx = q.x * q.x, yy = q.y * q.y, zz = q.z * q.z, xy = q.x * q.y, xz = q.x * q.z, yz = q.y * q.z;
  const vfloat wx = q.w * q.x, wy = q.w * q.y, wz = q.w * q.z;
  return {{{1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy)},
           {2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx)},
           {2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy)}}};
}

// (R S) (R S)^T
GSPLAT_INLINE Symmetric3 outer_square(const Matrix3& r, const vfloat s[3]) {
  vfloat half[3][3];
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) half[i][k] = r.m[i][k] * s[k];
  Symmetric3 c;
  int n = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j) c.v[n++] = half[i][0] * half[j][0] + half[i][1] * half[j][1] + half[i][2] * half[j][2];
  return c;
}

// Backpropagate the gradient `g` of outer_square's result, a full symmetric matrix: add to `v_r`, and write `v_s`.
GSPLAT_INLINE void outer_square_backward(const Matrix3& r, const vfloat s[3], const Symmetric3& g, Matrix3& v_r, vfloat v_s[3]) {
  const vfloat full[3][3] = {{g.v[0], g.v[1], g.v[2]}, {g.v[1], g.v[3], g.v[4]}, {g.v[2], g.v[4], g.v[5]}};
  for (int k = 0; k < 3; ++k) {
    v_s[k] = vfloat{};
    for (int i = 0; i < 3; ++i) {
      const vfloat v_half = 2 * s[k] * (full[i][0] * r.m[0][k] + full[i][1] * r.m[1][k] + full[i][2] * r.m[2][k]);
      v_r.m[i][k] += v_half * s[k];
      v_s[k] += v_half * r.m[i][k];
    }
  }
}

// Gradient of rotation_of and of the preceding normalisation.
GSPLAT_INLINE void rotation_backward(const UnitQuat& q, const Matrix3& v, vfloat v_q[4]) {
  const vfloat a01 = v.m[1][0] - v.m[0][1], a02 = v.m[0][2] - v.m[2][0], a12 = v.m[2][1] - v.m[1][2];
  const vfloat s01 = v.m[1][0] + v.m[0][1], s02 = v.m[0][2] + v.m[2][0], s12 = v.m[2][1] + v.m[1][2];
  const vfloat w = 2 * (q.x * a12 + q.y * a02 + q.z * a01);
  const vfloat x = 2 * (-2 * q.x * (v.m[1][1] + v.m[2][2]) + q.y * s01 + q.z * s02 + q.w * a12);
  const vfloat y = 2 * (q.x * s01 - 2 * q.y * (v.m[0][0] + v.m[2][2]) + q.z * s12 + q.w * a02);
  const vfloat z = 2 * (q.x * s02 + q.y * s12 - 2 * q.z * (v.m[0][0] + v.m[1][1]) + q.w * a01);
  const vfloat along = w * q.w + x * q.x + y * q.y + z * q.z;
  v_q[0] = (w - along * q.w) * q.inverse_norm;
  v_q[1] = (x - along * q.x) * q.inverse_norm;
  v_q[2] = (y - along * q.y) * q.inverse_norm;
  v_q[3] = (z - along * q.z) * q.inverse_norm;
}

}  // namespace GSPLAT_ISA::covariance
