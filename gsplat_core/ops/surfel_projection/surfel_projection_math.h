// Projection of one surfel per lane to one camera, forward and backward; shared by the CPU and CUDA kernels.
//
// The point (u, v) of a surfel, in standard deviations, is u s_0 r_0 + v s_1 r_1 + p in camera axes, with r_k the columns of
// its rotation and p its centre. Columns of `edges` are s_0 r_0, s_1 r_1 and p. The intrinsics turn them into the columns of
// the ray transform. The box of the ellipse u^2 + v^2 = 1 follows from the rows M_x, M_y, M_w of the ray transform:
// with <a, b> = a_0 b_0 + a_1 b_1 - a_2 b_2 its centre is <M_x, M_w> / <M_w, M_w>. The image of p is the origin of these
// products, so that no large numbers cancel.
#pragma once

#include "../covariance/covariance_math.h"
#include "constants.h"
#include "simd.h"
#include "surfel_projection.h"

namespace GSPLAT_ISA::surfel_projection {

using namespace gsplat::surfel_projection;
using namespace covariance;

constexpr float kHuge = 1e30f;  // larger numbers count as infinite, because their square is

// Also false for NaN.
GSPLAT_INLINE vint finite(vfloat x) { return (x > -kHuge) & (x < kHuge); }

struct View {
  float w[3][3], translation[3];
  float fx, fy, cx, cy;

  explicit GSPLAT_METHOD View(const Inputs& in) {
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) w[i][j] = in.viewmat[4 * i + j];
      translation[i] = in.viewmat[4 * i + 3];
    }
    fx = in.intrinsics[0], fy = in.intrinsics[4], cx = in.intrinsics[2], cy = in.intrinsics[5];
  }
};

// A surfel in camera axes.
struct Surfel {
  UnitQuat quat;
  Matrix3 rotation;  // of the surfel in the world
  Matrix3 axes;      // the same in camera axes
  vfloat p[3];       // centre
};

GSPLAT_INLINE Surfel to_camera(const View& view, const vfloat mean[3], const vfloat quat[4]) {
  Surfel s;
  s.quat = normalise(quat);
  s.rotation = rotation_of(s.quat);
  for (int i = 0; i < 3; ++i) {
    s.p[i] = view.w[i][0] * mean[0] + view.w[i][1] * mean[1] + view.w[i][2] * mean[2] + view.translation[i];
    for (int k = 0; k < 3; ++k)
      s.axes.m[i][k] = view.w[i][0] * s.rotation.m[0][k] + view.w[i][1] * s.rotation.m[1][k] + view.w[i][2] * s.rotation.m[2][k];
  }
  return s;
}

GSPLAT_INLINE vfloat sign_towards_camera(const Surfel& s) {
  const vfloat along = s.axes.m[0][2] * s.p[0] + s.axes.m[1][2] * s.p[1] + s.axes.m[2][2] * s.p[2];
  return select(along < 0, splat(1.0f), splat(-1.0f));
}

// Bounding box of the projected ellipse, relative to the image of the centre.
struct Box {
  vfloat image[2];      // the centre's image, relative to the principal point
  vfloat edges[3][3];   // columns as described above
  vfloat around[2][3];  // M_x and M_y with the centre's image as origin
  vfloat factors[3];    // (1, 1, -1) / <M_w, M_w>
  vfloat distance;      // <M_w, M_w>
  vfloat offset[2];     // from the centre's image to the centre of the box
};

GSPLAT_INLINE Box box_of(const View& view, const Surfel& s, const vfloat scales[3]) {
  Box b;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < 2; ++k) b.edges[i][k] = s.axes.m[i][k] * scales[k];
    b.edges[i][2] = s.p[i];
  }
  const vfloat* const w = b.edges[2];
  const float focal[2] = {view.fx, view.fy};
  for (int a = 0; a < 2; ++a) {
    b.image[a] = focal[a] * s.p[a] / s.p[2];
    for (int k = 0; k < 2; ++k) b.around[a][k] = focal[a] * b.edges[a][k] - b.image[a] * w[k];
    b.around[a][2] = vfloat{};
  }
  b.distance = w[0] * w[0] + w[1] * w[1] - w[2] * w[2];
  const vfloat inverse = 1.0f / b.distance;
  b.factors[0] = b.factors[1] = inverse;
  b.factors[2] = -inverse;
  for (int a = 0; a < 2; ++a) b.offset[a] = (b.around[a][0] * w[0] + b.around[a][1] * w[1]) * inverse;
  return b;
}

struct Projected {
  vint valid;  // if false, the other members are undefined
  vfloat radii[2], mean2d[2], depth, transform[9], normal[3];
};

GSPLAT_INLINE Projected project(const Inputs& in, const View& view, const vfloat mean[3], const vfloat quat[4],
                                const vfloat scales[3]) {
  const Surfel s = to_camera(view, mean, quat);
  const Box b = box_of(view, s, scales);
  Projected out;
  vint valid = (s.p[2] > in.near_plane) & (s.p[2] < in.far_plane) & s.quat.valid;
  valid &= ((b.distance < 0) | (b.distance > 0)) & finite(scales[2]);
  const float center[2] = {view.cx, view.cy}, size[2] = {in.width, in.height};
  vint large = splat_int(0);
  for (int a = 0; a < 2; ++a) {
    const vfloat square =
        b.offset[a] * b.offset[a] - (b.around[a][0] * b.around[a][0] + b.around[a][1] * b.around[a][1]) * b.factors[0];
    const vfloat extent = gsplat::kMaxExtentSigmas * sqrt(max(square, splat(kLeastExtentSquared)));
    out.radii[a] = min(ceil(extent), splat(gsplat::kMaxRadiusPx));
    out.mean2d[a] = b.image[a] + center[a] + b.offset[a];
    valid &= finite(out.mean2d[a]) & (out.mean2d[a] + out.radii[a] > 0) & (out.mean2d[a] - out.radii[a] < size[a]);
    large |= out.radii[a] > in.radius_clip;
  }
  valid &= large;
  const float focal[2] = {view.fx, view.fy};
  for (int k = 0; k < 3; ++k) {
    for (int a = 0; a < 2; ++a) out.transform[3 * a + k] = focal[a] * b.edges[a][k] + center[a] * b.edges[2][k];
    out.transform[6 + k] = b.edges[2][k];
  }
  for (int i = 0; i < 9; ++i) valid &= finite(out.transform[i]);
  const vfloat sign = sign_towards_camera(s);
  for (int i = 0; i < 3; ++i) out.normal[i] = sign * s.axes.m[i][2];
  out.depth = s.p[2];
  out.valid = valid;
  return out;
}

struct ProjectedGradient {
  vfloat mean2d[2], depth, transform[9], normal[3];
};

struct BackProjected {
  vfloat mean[3], quat[4], scales[3];
  vfloat viewmat[kMatrixSums];
};

GSPLAT_INLINE BackProjected project_backward(const View& view, const vfloat mean[3], const vfloat quat[4], const vfloat scales[3],
                                             const ProjectedGradient& v) {
  const Surfel s = to_camera(view, mean, quat);
  const Box b = box_of(view, s, scales);
  const float focal[2] = {view.fx, view.fy}, center[2] = {view.cx, view.cy};
  // Gradient of `edges`. With the centre of the box as origin, the box's centre is 0 and moves by <dM, M_w> / <M_w, M_w> +
  // <M, dM_w> / <M_w, M_w>, with M = `around` - offset M_w.
  vfloat v_edges[3][3];
  for (int k = 0; k < 3; ++k) v_edges[2][k] = v.transform[6 + k];
  v_edges[2][2] += v.depth;
  for (int a = 0; a < 2; ++a)
    for (int k = 0; k < 3; ++k) {
      const vfloat by_box = v.mean2d[a] * b.factors[k], w = b.edges[2][k];
      v_edges[a][k] = focal[a] * (v.transform[3 * a + k] + by_box * w);
      // (center - box centre) w, of the rows of the ray transform at the box's centre
      v_edges[2][k] +=
          center[a] * v.transform[3 * a + k] + by_box * (b.around[a][k] - b.offset[a] * w - (b.image[a] + b.offset[a]) * w);
    }
  const vfloat sign = sign_towards_camera(s);
  vfloat v_axes[3][3];  // of the rotation in camera axes
  for (int k = 0; k < 2; ++k) {
    for (int i = 0; i < 3; ++i) v_axes[i][k] = v_edges[i][k] * scales[k];
  }
  for (int i = 0; i < 3; ++i) v_axes[i][2] = sign * v.normal[i];

  BackProjected out;
  Matrix3 v_rotation;
  for (int j = 0; j < 3; ++j) {
    out.mean[j] = view.w[0][j] * v_edges[0][2] + view.w[1][j] * v_edges[1][2] + view.w[2][j] * v_edges[2][2];
    for (int k = 0; k < 3; ++k)
      v_rotation.m[j][k] = view.w[0][j] * v_axes[0][k] + view.w[1][j] * v_axes[1][k] + view.w[2][j] * v_axes[2][k];
  }
  rotation_backward(s.quat, v_rotation, out.quat);
  for (int k = 0; k < 2; ++k)
    out.scales[k] = v_edges[0][k] * s.axes.m[0][k] + v_edges[1][k] * s.axes.m[1][k] + v_edges[2][k] * s.axes.m[2][k];
  out.scales[2] = vfloat{};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j)
      out.viewmat[3 * i + j] = v_edges[i][2] * mean[j] + v_axes[i][0] * s.rotation.m[j][0] + v_axes[i][1] * s.rotation.m[j][1] +
                               v_axes[i][2] * s.rotation.m[j][2];
    out.viewmat[9 + i] = v_edges[i][2];
  }
  return out;
}

}  // namespace GSPLAT_ISA::surfel_projection
