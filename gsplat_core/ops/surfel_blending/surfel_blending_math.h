// Record of a surfel, its intersection with the rays of pixels, and the conversion of its sums over pixels to gradients;
// shared by the CPU and CUDA kernels. Numbers of one surfel are computed in double precision, those of pixels in vectors.
#pragma once

#include "constants.h"
#include "simd.h"
#include "surfel_blending.h"

namespace GSPLAT_ISA::surfel_blending {

using namespace gsplat::surfel_blending;

constexpr float kHalfLog2E = 0.72134752f;

#if defined(__CUDACC__)
GSPLAT_INLINE double square_root(double x) { return ::sqrt(x); }
GSPLAT_INLINE double logarithm(double x) { return ::log(x); }
#else
GSPLAT_INLINE double square_root(double x) { return __builtin_sqrt(x); }
GSPLAT_INLINE double logarithm(double x) { return __builtin_log(x); }
#endif

GSPLAT_INLINE void cross(const double* a, const double* b, double* out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

// Rows of a ray transform with the projected centre as origin, and the coefficients of q = a + dx b + dy c.
struct Plane {
  double x[3], y[3], w[3];
  double a[3], b[3], c[3];
  double scale;  // factor of the coefficients in the record; 0 if every ray is parallel to the surfel
};

GSPLAT_INLINE double magnitude(double x) { return x < 0 ? -x : x; }

GSPLAT_INLINE Plane plane_of(const float* mean, const float* transform) {
  Plane p;
  for (int k = 0; k < 3; ++k) {
    p.w[k] = transform[6 + k];
    p.x[k] = transform[k] - mean[0] * p.w[k];
    p.y[k] = transform[3 + k] - mean[1] * p.w[k];
  }
  cross(p.x, p.y, p.a);
  cross(p.y, p.w, p.b);
  cross(p.w, p.x, p.c);
  double most = magnitude(p.a[2]);
  if (magnitude(p.b[2]) > most) most = magnitude(p.b[2]);
  if (magnitude(p.c[2]) > most) most = magnitude(p.c[2]);
  p.scale = most > 1e-300 ? 1 / most : 0;
  return p;
}

GSPLAT_INLINE Record unusable_record() { return {0, 0, -__builtin_inff(), {}}; }

// Prepare a surfel for blending. `usable`: all inputs of the surfel are finite.
GSPLAT_INLINE Record record_of(const float* mean, const Plane& p, float opacity, bool usable) {
  constexpr float kFaint = gsplat::kAlphaCutoff * (1 - 1e-5f);
  if (!usable || !(opacity >= kFaint) || !(p.scale > 0)) return unusable_record();
  Record r = {mean[0], mean[1], float(logarithm(opacity) * 1.4426950408889634), {}};
  float check = 0;
  for (int k = 0; k < 3; ++k) {
    r.q[k] = float(p.a[k] * p.scale);
    r.q[3 + k] = float(p.b[k] * p.scale);
    r.q[6 + k] = float(p.c[k] * p.scale);
    check += 0 * r.q[k] + 0 * r.q[3 + k] + 0 * r.q[6 + k];
  }
  return check == 0 ? r : unusable_record();
}

// Bound of a usable surfel. The contour alpha = 1/255 is u^2 + v^2 = level, or a circle in pixels. The image of the former is
// an ellipse with the centre <m, w> / <w, w> and the matrix of second moments center center' - <m, m'> / <w, w>, where <a, b>
// = level (a_0 b_0 + a_1 b_1) - a_2 b_2 (../surfel_projection). The sum of the matrices of two ellipses is that of one that
// contains both. A surfel that extends behind the camera is not bounded.
GSPLAT_INLINE Bound bound_of(const float* mean, const Plane& p, float opacity) {
  const double level = 2 * (logarithm(double(opacity) / gsplat::kAlphaCutoff) + 1e-3);
  const auto product = [&](const double* a, const double* b) { return level * (a[0] * b[0] + a[1] * b[1]) - a[2] * b[2]; };
  const double distance = product(p.w, p.w);
  if (!(distance < -1e-9 * p.w[2] * p.w[2])) return {mean[0], mean[1], {}};
  const double x = product(p.x, p.w) / distance, y = product(p.y, p.w) / distance;
  const double circle = square_root(level / kScreenFactor) + square_root(x * x + y * y) + 0.01;
  const double xx = (x * x - product(p.x, p.x) / distance) * 1.0001 + circle * circle;
  const double yy = (y * y - product(p.y, p.y) / distance) * 1.0001 + circle * circle;
  const double xy = x * y - product(p.x, p.y) / distance, scale = level / (xx * yy - xy * xy);
  if (!(scale > 0)) return {mean[0], mean[1], {}};
  return {float(mean[0] + x), float(mean[1] + y), {float(yy * scale), float(-xy * scale), float(xx * scale)}};
}

// Intersection of the rays of pixels with a surfel.
struct Hit {
  vfloat dx, dy;         // from the projected centre to the pixels
  vfloat denominator;    // q_2; 0 where the ray is parallel to the surfel
  vfloat inverse, u, v;  // 1 / q_2, and the intersection
  vfloat plane, screen;  // u^2 + v^2 and 2 d^2; the smaller of them is 2 sigma
};
// Intersect the rays of pixels (x, y) with a surfel. The order of operations is explicit, so that the forward and
// backward pass compute identical bits.
GSPLAT_INLINE Hit hit_at(const Record& r, vfloat x, vfloat y) {
  Hit h;
  h.dx = x - r.x;
  h.dy = y - r.y;
  vfloat q[3];
  for (int k = 0; k < 3; ++k) q[k] = fma(splat(r.q[6 + k]), h.dy, fma(splat(r.q[3 + k]), h.dx, splat(r.q[k])));
  h.denominator = q[2];
  h.inverse = reciprocal(q[2]);
  h.u = q[0] * h.inverse;
  h.v = q[1] * h.inverse;
  h.plane = fma(h.u, h.u, h.v * h.v);
  h.screen = kScreenFactor * fma(h.dx, h.dx, h.dy * h.dy);
  return h;
}

// log2(alpha) before clamping and cut-off; `nearest` is the smaller of `plane` and `screen`.
GSPLAT_INLINE vfloat power_of(const Record& r, vfloat nearest) { return fma(splat(-kHalfLog2E), nearest, splat(r.l)); }

// Add the terms of pixels to the first kMoments - 1 sums. `s` is alpha dL/dalpha, 0 where alpha is clamped; `on_plane` is
// the same where sigma follows from the intersection, else 0.
GSPLAT_INLINE void add_moments(const Hit& h, vfloat s, vfloat on_plane, vfloat* sum) {
  const vfloat along_u = on_plane * h.u, along_v = on_plane * h.v;
  const vfloat v_q[3] = {-along_u * h.inverse, -along_v * h.inverse, (along_u * h.u + along_v * h.v) * h.inverse};
  const vfloat on_screen = s - on_plane;
  sum[0] = sum[0] + s;
  for (int k = 0; k < 3; ++k) {
    sum[1 + k] = sum[1 + k] + v_q[k];
    sum[4 + k] = sum[4 + k] + v_q[k] * h.dx;
    sum[7 + k] = sum[7 + k] + v_q[k] * h.dy;
  }
  sum[kScreenMoments] = sum[kScreenMoments] + on_screen * h.dx;
  sum[kScreenMoments + 1] = sum[kScreenMoments + 1] + on_screen * h.dy;
}

// Convert the sums over pixels of a surfel to its gradients.
GSPLAT_INLINE void surfel_gradients(const float* sums, const float* mean, const float* transform, float opacity, float* v_mean,
                                    float* v_transform, float* v_opacity, float* v_densify) {
  const Plane p = plane_of(mean, transform);
  double g[3][3];  // of a, b and c
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) g[i][k] = double(sums[1 + 3 * i + k]) * p.scale;
  double parts[6][3];
  cross(p.y, g[0], parts[0]);  // a = x cross y
  cross(g[2], p.w, parts[1]);  // c = w cross x
  cross(g[0], p.x, parts[2]);
  cross(p.w, g[1], parts[3]);  // b = y cross w
  cross(g[1], p.y, parts[4]);
  cross(p.x, g[2], parts[5]);
  double v[3][3];
  for (int k = 0; k < 3; ++k) {
    v[0][k] = parts[0][k] + parts[1][k];
    v[1][k] = parts[2][k] + parts[3][k];
    // The rows x and y of the plane contain -mean times w.
    v[2][k] = parts[4][k] + parts[5][k] - mean[0] * v[0][k] - mean[1] * v[1][k];
    for (int i = 0; i < 3; ++i) v_transform[3 * i + k] = float(v[i][k]);
  }
  for (int i = 0; i < 2; ++i) {
    v_mean[i] = kScreenFactor * sums[kScreenMoments + i];
    v_densify[i] = v_transform[3 * i + 2] * transform[8];
  }
  *v_opacity = sums[0] / opacity;
}

}  // namespace GSPLAT_ISA::surfel_blending
