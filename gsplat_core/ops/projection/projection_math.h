// Projection of one Gaussian per lane to one camera, forward and backward; shared by the CPU and CUDA kernels.
#pragma once

#include "../covariance/covariance_math.h"
#include "camera_models.h"
#include "constants.h"
#include "projection.h"
#include "simd.h"

namespace GSPLAT_ISA::projection {

using namespace gsplat::projection;
using namespace covariance;

constexpr float kHuge = 1e30f;  // larger numbers count as infinite, because their square is

// Also false for NaN.
GSPLAT_INLINE vint finite(vfloat x) { return (x > -kHuge) & (x < kHuge); }

// Camera parameters that the projection and its gradient both use.
template <CameraModel model>
struct View {
  Matrix3 w;  // rotation of the camera, identical in every lane
  vfloat translation[3];
  Intrinsics k;

  explicit GSPLAT_METHOD View(const ProjectionInput& in) {
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) w.m[i][j] = splat(in.viewmat[4 * i + j]);
      translation[i] = splat(in.viewmat[4 * i + 3]);
    }
    k = intrinsics_of(in.intrinsics, in.width, in.height);
  }

  GSPLAT_METHOD Point3 to_camera(const vfloat m[3]) const {
    vfloat p[3];
    for (int i = 0; i < 3; ++i) p[i] = w.m[i][0] * m[0] + w.m[i][1] * m[1] + w.m[i][2] * m[2] + translation[i];
    return {p[0], p[1], p[2]};
  }
};

struct Geometry {
  Symmetric3 sigma;
  vint valid;
  UnitQuat quat;  // this and the next two only if the covariance is built from them
  Matrix3 rotation;
  vfloat scales[3];
};

GSPLAT_INLINE Geometry geometry_of(const vfloat quat[4], const vfloat scales[3]) {
  Geometry g;
  for (int k = 0; k < 3; ++k) g.scales[k] = scales[k];
  g.quat = normalise(quat);
  g.rotation = rotation_of(g.quat);
  g.sigma = outer_square(g.rotation, g.scales);
  g.valid = g.quat.valid;
  for (int i = 0; i < 6; ++i) g.valid &= finite(g.sigma.v[i]);
  return g;
}

GSPLAT_INLINE Geometry geometry_of(const Symmetric3& sigma) {
  Geometry g;
  g.sigma = sigma;
  g.valid = splat_int(-1);
  for (int i = 0; i < 6; ++i) g.valid &= finite(g.sigma.v[i]);
  return g;
}

struct Ellipse {
  vfloat affine[2][3];  // A = J W
  vfloat half[2][3];    // A Sigma
  vfloat a0, b, c0;     // A Sigma A^T, before the blur
};

template <CameraModel model>
GSPLAT_INLINE Ellipse ellipse_of(const View<model>& view, const ImagePoint& image, const Symmetric3& s) {
  Ellipse e;
  const vfloat full[3][3] = {{s.v[0], s.v[1], s.v[2]}, {s.v[1], s.v[3], s.v[4]}, {s.v[2], s.v[4], s.v[5]}};
  for (int r = 0; r < 2; ++r) {
    for (int c = 0; c < 3; ++c)
      e.affine[r][c] = image.j[r][0] * view.w.m[0][c] + image.j[r][1] * view.w.m[1][c] + image.j[r][2] * view.w.m[2][c];
    for (int c = 0; c < 3; ++c)
      e.half[r][c] = e.affine[r][0] * full[0][c] + e.affine[r][1] * full[1][c] + e.affine[r][2] * full[2][c];
  }
  const auto dot = [&](int r, int c) {
    return e.half[r][0] * e.affine[c][0] + e.half[r][1] * e.affine[c][1] + e.half[r][2] * e.affine[c][2];
  };
  e.a0 = dot(0, 0);
  e.b = dot(0, 1);
  e.c0 = dot(1, 1);
  return e;
}

GSPLAT_INLINE vfloat compensation_of(const Ellipse& e, vfloat det, float floor) {
  return sqrt(max((e.a0 * e.c0 - e.b * e.b) / det, splat(floor * floor)));
}

struct Projected {
  vint valid;  // if false, the other members are undefined
  vfloat u, v, depth, conic[3];
  vfloat compensation = {}, radius_x = {}, radius_y = {};
  vfloat half_x = {}, half_y = {};  // the radii before they are rounded up
  vfloat determinant = {};          // of the blurred 2D covariance
};

// Compute a splat's ellipse from its 2D covariance. `opacity` may be null. Without `compensate` the compensation is 0.
template <CameraModel model>
GSPLAT_INLINE Projected project(const ProjectionInput& in, const View<model>& view, const vfloat mean[3],
                                const Geometry& geometry, const vfloat* opacity, bool compensate) {
  const Point3 p = view.to_camera(mean);
  vint valid = (p.z >= in.near_plane) & (p.z <= in.far_plane) & finite(p.x) & finite(p.y) & finite(p.z);
  valid &= geometry.valid;
  const ImagePoint image = Projector<model>::forward(view.k, p);
  const Ellipse e = ellipse_of(view, image, geometry.sigma);
  const vfloat a = e.a0 + in.eps2d, c = e.c0 + in.eps2d;
  const vfloat det = a * c - e.b * e.b;
  valid &= (det > 0) & (det < kHuge) & finite(image.u) & finite(image.v);
  const vfloat inverse = 1.0f / det;
  Projected out = {valid, image.u, image.v, p.z, {c * inverse, -e.b * inverse, a * inverse}};
  valid &= finite(out.conic[0]) & finite(out.conic[1]) & finite(out.conic[2]);

  vfloat extent = splat(gsplat::kMaxExtentSigmas);
  if (compensate) out.compensation = compensation_of(e, det, in.compensation_floor);
  if (opacity != nullptr) {
    const vfloat effective = compensate ? *opacity * out.compensation : *opacity;
    valid &= (effective >= gsplat::kAlphaCutoff) & finite(effective);
    // 2 ln(o / cutoff) = 2 ln 2 log2(o / cutoff)
    const vfloat ratio = select(valid, effective * (1.0f / gsplat::kAlphaCutoff), splat(1.0f));
    extent = min(extent, sqrt(max(1.38629436f * log2(ratio), vfloat{})));
  }
  out.half_x = extent * sqrt(max(a, vfloat{}));
  out.half_y = extent * sqrt(max(c, vfloat{}));
  out.determinant = det;
  const vfloat rx = min(ceil(out.half_x), splat(gsplat::kMaxRadiusPx));
  const vfloat ry = min(ceil(out.half_y), splat(gsplat::kMaxRadiusPx));
  valid &= (rx > in.radius_clip) | (ry > in.radius_clip);
  valid &= (image.u + rx > 0) & (image.u - rx < in.width) & (image.v + ry > 0) & (image.v - ry < in.height);
  out.valid = valid;
  out.radius_x = rx;
  out.radius_y = ry;
  return out;
}

template <CameraModel model_>
struct CameraModelConstant {
  static constexpr CameraModel value = model_;
};

// Call run with the camera model as a constant, and return its result.
template <class Run>
GSPLAT_INLINE auto with_camera_model(int model, const Run& run) {
  switch (model) {
    case kOrtho: return run(CameraModelConstant<kOrtho>());
    case kFisheye: return run(CameraModelConstant<kFisheye>());
    default: return run(CameraModelConstant<kPinhole>());
  }
}

// Project Gaussians by the camera model of the input.
GSPLAT_INLINE Projected project(const ProjectionInput& in, const vfloat mean[3], const Geometry& geometry, const vfloat* opacity,
                                bool compensate) {
  return with_camera_model(
      in.model, [&](auto model) { return project(in, View<decltype(model)::value>(in), mean, geometry, opacity, compensate); });
}

// Return the gradient of the blurred 2D covariance as a symmetric matrix (xx, xy, yy), from those of its inverse and of
// the compensation. A compensation at its lower bound has no gradient.
GSPLAT_INLINE void covariance2d_gradient(const Ellipse& e, const ProjectionInput& in, const vfloat v_conic[3], bool compensate,
                                         vfloat v_compensation, vfloat g[3]) {
  const vfloat a = e.a0 + in.eps2d, c = e.c0 + in.eps2d, b = e.b;
  const vfloat det = a * c - b * b, inverse = 1.0f / det;
  const vfloat x = c * inverse, y = -b * inverse, z = a * inverse;  // X is the conic; the gradient is -X V X
  const vfloat v0 = v_conic[0], v1 = 0.5f * v_conic[1], v2 = v_conic[2];
  const vfloat m00 = v0 * x + v1 * y, m01 = v0 * y + v1 * z, m10 = v1 * x + v2 * y, m11 = v1 * y + v2 * z;  // V X
  g[0] = -(x * m00 + y * m10);
  g[1] = -(x * m01 + y * m11);
  g[2] = -(y * m01 + z * m11);
  if (compensate) {
    const vfloat ratio = (e.a0 * e.c0 - b * b) * inverse;
    const vint free = ratio > in.compensation_floor * in.compensation_floor;
    const vfloat v_ratio = select(free, 0.5f * v_compensation / sqrt(select(free, ratio, splat(1.0f))), vfloat{}) * inverse;
    g[0] += v_ratio * (e.c0 - ratio * c);
    g[1] += v_ratio * b * (ratio - 1);
    g[2] += v_ratio * (e.a0 - ratio * a);
  }
}

// Gradients of the outputs of one Gaussian's projection.
struct ProjectedGradient {
  vfloat means2d[2], depth, conic[3], compensation;
};

// Gradients of the inputs: the covariance (upper triangle), or quaternion and scales; and the camera's rotation row by
// row and translation.
struct BackProjected {
  vfloat mean[3], quat[4], scales[3], viewmat[12];
  Symmetric3 sigma;
};

// Backpropagate the gradient g of the blurred 2D covariance (xx, xy, yy; as a symmetric matrix), of the image point and
// of the depth.
template <CameraModel model>
GSPLAT_INLINE BackProjected project_backward(const ProjectionInput& in, const View<model>& view, const vfloat mean[3],
                                             const Geometry& geometry, const Point3& p, const ImagePoint& image, const Ellipse& e,
                                             const vfloat g[3], const vfloat v_means2d[2], vfloat v_depth, bool needs_viewmat) {
  BackProjected to = {};
  // Sigma' = A Sigma A^T: v_Sigma = A^T G A, v_A = 2 G A Sigma
  const vfloat G[2][2] = {{g[0], g[1]}, {g[1], g[2]}};
  vfloat ga[2][3], v_affine[2][3];
  for (int r = 0; r < 2; ++r)
    for (int c = 0; c < 3; ++c) {
      ga[r][c] = G[r][0] * e.affine[0][c] + G[r][1] * e.affine[1][c];
      v_affine[r][c] = 2 * (G[r][0] * e.half[0][c] + G[r][1] * e.half[1][c]);
    }
  int n = 0;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j) to.sigma.v[n++] = e.affine[0][i] * ga[0][j] + e.affine[1][i] * ga[1][j];

  vfloat v_j[2][3];
  for (int r = 0; r < 2; ++r)
    for (int c = 0; c < 3; ++c)
      v_j[r][c] = v_affine[r][0] * view.w.m[c][0] + v_affine[r][1] * view.w.m[c][1] + v_affine[r][2] * view.w.m[c][2];
  const Point3 v_point = Projector<model>::backward(view.k, p, v_means2d[0], v_means2d[1], v_j);
  const vfloat v_p[3] = {v_point.x, v_point.y, v_point.z + v_depth};
  for (int i = 0; i < 3; ++i) to.mean[i] = view.w.m[0][i] * v_p[0] + view.w.m[1][i] * v_p[1] + view.w.m[2][i] * v_p[2];
  if (needs_viewmat)
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j)
        to.viewmat[3 * i + j] = image.j[0][i] * v_affine[0][j] + image.j[1][i] * v_affine[1][j] + v_p[i] * mean[j];
      to.viewmat[9 + i] = v_p[i];
    }
  if (in.covars != nullptr) {
    to.sigma.v[1] *= 2;  // each off-diagonal value of the triangle occurs twice in the matrix
    to.sigma.v[2] *= 2;
    to.sigma.v[4] *= 2;
  } else {
    Matrix3 v_rotation = {};
    outer_square_backward(geometry.rotation, geometry.scales, to.sigma, v_rotation, to.scales);
    rotation_backward(geometry.quat, v_rotation, to.quat);
  }
  return to;
}

template <CameraModel model>
GSPLAT_INLINE BackProjected project_backward(const ProjectionInput& in, const View<model>& view, const vfloat mean[3],
                                             const Geometry& geometry, const ProjectedGradient& v, bool compensate,
                                             bool needs_viewmat) {
  const Point3 p = view.to_camera(mean);
  const ImagePoint image = Projector<model>::forward(view.k, p);
  const Ellipse e = ellipse_of(view, image, geometry.sigma);
  vfloat g[3];
  covariance2d_gradient(e, in, v.conic, compensate, v.compensation, g);
  return project_backward(in, view, mean, geometry, p, image, e, g, v.means2d, v.depth, needs_viewmat);
}

}  // namespace GSPLAT_ISA::projection
