// Unscented transform of one Gaussian per lane, forward and backward; shared by the CPU and CUDA kernels.
#pragma once

#include "../projection/projection_math.h"
#include "lens_math.h"

namespace GSPLAT_ISA::unscented_projection {

constexpr int kSigmaPoints = 7;

// Gaussian as read from memory, and its principal axes times the standard deviations and the spread.
struct Gaussian {
  vfloat mean[3], scale[3];
  covariance::UnitQuat quat;
  covariance::Matrix3 rotation;
  float spread;
  vint usable;

  GSPLAT_METHOD Point3 sigma_point(int i) const {
    if (i == 0) return {mean[0], mean[1], mean[2]};
    const int k = (i - 1) % 3;
    const vfloat length = i > 3 ? -spread * scale[k] : spread * scale[k];
    return {mean[0] + length * rotation.m[0][k], mean[1] + length * rotation.m[1][k], mean[2] + length * rotation.m[2][k]};
  }
};

GSPLAT_INLINE Gaussian gaussian_of(const vfloat mean[3], const vfloat quat[4], const vfloat scale[3], float spread) {
  const vfloat none = vfloat{}, one = splat(1.0f);
  vfloat check = none;  // NaN if any value is not finite
  for (int k = 0; k < 3; ++k) check += 0.0f * mean[k] + 0.0f * scale[k];
  for (int k = 0; k < 4; ++k) check += 0.0f * quat[k];
  Gaussian g;
  g.usable = (check == 0.0f) & covariance::normalise(quat).valid;
  for (int k = 0; k < 3; ++k) g.mean[k] = select(g.usable, mean[k], none), g.scale[k] = select(g.usable, scale[k], one);
  const vfloat turn[4] = {select(g.usable, quat[0], one), select(g.usable, quat[1], none), select(g.usable, quat[2], none),
                          select(g.usable, quat[3], none)};
  g.quat = covariance::normalise(turn);
  g.rotation = covariance::rotation_of(g.quat);
  g.spread = spread;
  return g;
}

// Moments of the sigma points' pixels. Positions are relative to the pixel of the mean: the weights are large and of both
// signs, so absolute positions would cancel.
struct Moments {
  vfloat u, v;                                  // pixel of the mean
  vfloat apart[kSigmaPoints - 1][2], moved[2];  // offsets of the outer points, and of the transformed mean
  projection::Ellipse covariance;               // members a0, b and c0 only
  vint seen;                                    // by the lens
  vint inside;                                  // the picture and its margin
};

GSPLAT_INLINE Moments moments_of(const Inputs& in, const Lens& lens, const Gaussian& g) {
  Moments m = {};
  const float across = in.margin * in.width, down = in.margin * in.height;
  for (int i = 0; i < kSigmaPoints; ++i) {
    vfloat time;
    const Pixel pixel = lens.pixel_of_world(g.sigma_point(i), time);
    const vint here = (pixel.u >= -across) & (pixel.u < in.width + across) & (pixel.v >= -down) & (pixel.v < in.height + down);
    if (i == 0) {
      m.u = pixel.u, m.v = pixel.v, m.seen = pixel.seen, m.inside = here;
      continue;
    }
    m.seen &= pixel.seen;
    m.inside = in.all_inside ? m.inside & here : m.inside | here;
    m.apart[i - 1][0] = pixel.u - m.u, m.apart[i - 1][1] = pixel.v - m.v;
    for (int d = 0; d < 2; ++d) m.moved[d] += in.weight * m.apart[i - 1][d];
  }
  vfloat a = in.center_weight * m.moved[0] * m.moved[0], b = in.center_weight * m.moved[0] * m.moved[1],
         c = in.center_weight * m.moved[1] * m.moved[1];
  for (int i = 0; i < kSigmaPoints - 1; ++i) {
    const vfloat x = m.apart[i][0] - m.moved[0], y = m.apart[i][1] - m.moved[1];
    a += in.weight * x * x, b += in.weight * x * y, c += in.weight * y * y;
  }
  m.covariance.a0 = a, m.covariance.b = b, m.covariance.c0 = c;
  return m;
}

GSPLAT_INLINE projection::Projected project(const Inputs& in, const Lens& lens, const Gaussian& g, const vfloat* opacity,
                                            bool compensate) {
  using projection::finite;
  const vfloat middle = splat(0.5f);
  const vfloat depth = lens.moved(lens.turned({g.mean[0], g.mean[1], g.mean[2]}, middle), middle).z;
  const Moments m = moments_of(in, lens, g);
  const projection::Ellipse& e = m.covariance;
  const vfloat u = m.u + m.moved[0], v = m.v + m.moved[1], a = e.a0 + in.eps2d, c = e.c0 + in.eps2d;
  const vfloat det = a * c - e.b * e.b, inverse = 1.0f / det;
  vint valid = g.usable & (depth >= in.near_plane) & (depth <= in.far_plane) & m.seen & m.inside;
  valid &= (det > 0.0f) & finite(det) & finite(u) & finite(v);
  projection::Projected out = {valid, u, v, depth, {c * inverse, -e.b * inverse, a * inverse}};
  valid &= finite(out.conic[0]) & finite(out.conic[1]) & finite(out.conic[2]);
  vfloat extent = splat(gsplat::kMaxExtentSigmas);
  if (compensate) out.compensation = projection::compensation_of(e, det, in.compensation_floor);
  if (opacity != nullptr) {
    const vfloat reached = compensate ? *opacity * out.compensation : *opacity;
    valid &= (reached >= gsplat::kAlphaCutoff) & finite(reached);
    const vfloat ratio = select(valid, reached * (1.0f / gsplat::kAlphaCutoff), splat(1.0f));
    extent = min(extent, sqrt(max(1.38629436f * log2(ratio), vfloat{})));  // sqrt(2 ln(opacity / cut-off))
  }
  out.radius_x = min(ceil(extent * sqrt(max(a, vfloat{}))), splat(gsplat::kMaxRadiusPx));
  out.radius_y = min(ceil(extent * sqrt(max(c, vfloat{}))), splat(gsplat::kMaxRadiusPx));
  valid &= (out.radius_x > in.radius_clip) | (out.radius_y > in.radius_clip);
  valid &= (u + out.radius_x > 0.0f) & (u - out.radius_x < in.width) & (v + out.radius_y > 0.0f) & (v - out.radius_y < in.height);
  out.valid = valid;
  return out;
}

struct GaussianGradient {
  vfloat mean[3], quat[4], scale[3];
};

GSPLAT_INLINE GaussianGradient project_backward(const Inputs& in, const Lens& lens, const Gaussian& g,
                                                const projection::ProjectedGradient& from, bool compensate) {
  const Moments m = moments_of(in, lens, g);
  projection::ProjectionInput blur = {};
  blur.eps2d = in.eps2d, blur.compensation_floor = in.compensation_floor;
  vfloat G[3];  // gradient of the covariance, a symmetric matrix
  projection::covariance2d_gradient(m.covariance, blur, from.conic, compensate, from.compensation, G);
  const auto times_G = [&](vfloat x, vfloat y, vfloat out[2]) { out[0] = G[0] * x + G[1] * y, out[1] = G[1] * x + G[2] * y; };
  // m.moved is the offset of the transformed mean from the projection of the centre. The offsets of the six outer points
  // from the transformed mean sum up to moved / weight - 6 moved.
  vfloat of_moved[2];
  times_G(m.moved[0], m.moved[1], of_moved);
  const float factor = 2 * (in.center_weight - in.weight * (1 / in.weight - 6));
  vfloat v_moved[2];
  for (int d = 0; d < 2; ++d) v_moved[d] = from.means2d[d] + factor * of_moved[d];
  GaussianGradient to = {};
  covariance::Matrix3 v_rotation = {};
  vfloat v_center[2] = {from.means2d[0], from.means2d[1]};
  for (int i = kSigmaPoints - 1; i >= 0; --i) {
    vfloat v_pixel[2] = {v_center[0], v_center[1]};
    if (i > 0) {
      vfloat of_rest[2];
      times_G(m.apart[i - 1][0] - m.moved[0], m.apart[i - 1][1] - m.moved[1], of_rest);
      for (int d = 0; d < 2; ++d) {
        v_pixel[d] = in.weight * (2 * of_rest[d] + v_moved[d]);
        v_center[d] -= v_pixel[d];
      }
    }
    const Point3 world = g.sigma_point(i);
    vfloat time;
    const Pixel pixel = lens.pixel_of_world(world, time);
    const Point3 v = lens.world_gradient(world, pixel, time, v_pixel[0], v_pixel[1]);
    const vfloat along[3] = {v.x, v.y, v.z};
    for (int d = 0; d < 3; ++d) to.mean[d] += along[d];
    if (i == 0) continue;
    const int k = (i - 1) % 3;
    const float sign = i > 3 ? -g.spread : g.spread;
    for (int d = 0; d < 3; ++d) {
      to.scale[k] += sign * along[d] * g.rotation.m[d][k];
      v_rotation.m[d][k] += sign * along[d] * g.scale[k];
    }
  }
  const Point3 nearer = lens.to_world({vfloat{}, vfloat{}, from.depth}, splat(0.5f));
  to.mean[0] += nearer.x, to.mean[1] += nearer.y, to.mean[2] += nearer.z;
  covariance::rotation_backward(g.quat, v_rotation, to.quat);
  return to;
}

}  // namespace GSPLAT_ISA::unscented_projection
