// From the sum of a Gaussian's gradient rows to the gradient of its raw parameters, one Gaussian per thread.
#pragma once

#include "../frame/gaussian.cuh"
#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "frame_gradients.h"

namespace gsplat::frame {
namespace {

using namespace GSPLAT_ISA;
using namespace GSPLAT_ISA::spherical_harmonics;

// The sum of a Gaussian's gradient rows.
struct SplatRow {
  float moments[6];  // sums over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha
  float colors[4];   // red, green, blue, z
};

// The gradient of a Gaussian's raw parameters.
struct RawGradient {
  float mean[3], quat[4], log_scales[3], color[3], logit;
};

// a b - c d without cancellation where the products are nearly equal (Kahan; Jeannerod et al. 2013).
__device__ inline float difference_of_products(float a, float b, float c, float d) {
  const float cd = __fmul_rn(c, d);
  return fmaf(a, b, -cd) + fmaf(-c, d, cd);
}

// Gradients of the projected mean and of the blurred covariance S (symmetric): S^-1 m and 1/2 S^-1 M S^-1, with m and M the
// moments of first and second order. Computed along the axes u and w of the ellipse: in x and y, a thin splat's component along
// its length, which is smaller by the squared ratio of the axes, would be lost to rounding.
struct EllipseGradient {
  float mean[2], covariance[3];
};
__device__ inline EllipseGradient ellipse_gradient(float a, float b, float c, const float* m) {
  const float half = 0.5f * (a - c), radius = sqrtf(half * half + b * b);
  const float longer = 0.5f * (a + c) + radius, shorter = difference_of_products(a, c, b, b) / longer;
  float x = half < 0 ? b : half + radius, y = half < 0 ? radius - half : b;  // u; w is (-y, x)
  const float norm = sqrtf(x * x + y * y);
  x = norm > 0 ? x / norm : 1;
  y = norm > 0 ? y / norm : 0;
  const float m_u = (x * m[1] + y * m[2]) / longer, m_w = difference_of_products(x, m[2], y, m[1]) / shorter;
  const float wx = difference_of_products(x, m[4], y, m[3]), wy = difference_of_products(x, m[5], y, m[4]);  // M w
  const float uu = (x * (x * m[3] + y * m[4]) + y * (x * m[4] + y * m[5])) / (longer * longer);
  const float uw = (x * wx + y * wy) / (longer * shorter), ww = difference_of_products(x, wy, y, wx) / (shorter * shorter);
  return {{x * m_u - y * m_w, y * m_u + x * m_w},
          {0.5f * (x * x * uu - 2 * x * y * uw + y * y * ww), 0.5f * (x * y * (uu - ww) + (x * x - y * y) * uw),
           0.5f * (y * y * uu + 2 * x * y * uw + x * x * ww)}};
}

template <CameraModel model>
__device__ inline RawGradient projection_gradient(const Scene& scene, const Camera& camera, const RawGaussian& gaussian,
                                                  const SplatRow& sum) {
  const ProjectionInput in = projection_input(scene, camera);
  const View<model> view(in);
  const Geometry geometry = geometry_of(gaussian);
  const Point3 p = view.to_camera(gaussian.mean);
  const ImagePoint image = Projector<model>::forward(view.k, p);
  const Ellipse e = ellipse_of(view, image, geometry.sigma);
  const EllipseGradient v = ellipse_gradient(e.a0 + scene.eps2d, e.b, e.c0 + scene.eps2d, sum.moments);
  const BackProjected back =
      project_backward(in, view, gaussian.mean, geometry, p, image, e, v.covariance, v.mean, sum.colors[3], false);
  RawGradient to = {};
  for (int k = 0; k < 3; ++k) to.mean[k] = back.mean[k];
  for (int k = 0; k < 4; ++k) to.quat[k] = back.quat[k];
  for (int k = 0; k < 3; ++k) to.log_scales[k] = back.scales[k] * geometry.scales[k];
  to.logit = sum.moments[0] * (1 - opacity_of(gaussian));  // dL/dlogit = o (1 - o) dL/do, and the first moment is o dL/do
  return to;
}

__device__ inline RawGradient projection_gradient(const Scene& scene, const Camera& camera, const RawGaussian& gaussian,
                                                  const SplatRow& sum) {
  switch (scene.camera_model) {
    case kOrtho: return projection_gradient<kOrtho>(scene, camera, gaussian, sum);
    case kFisheye: return projection_gradient<kFisheye>(scene, camera, gaussian, sum);
    default: return projection_gradient<kPinhole>(scene, camera, gaussian, sum);
  }
}

template <int kDegree>
constexpr int kBasesOf = (kDegree + 1) * (kDegree + 1);

// Chain rule of the colour: to the view direction and so to the mean, and to the coefficients c, which are replaced by their
// gradient. A channel that was clamped at zero has no gradient.
template <int kDegree>
__device__ inline void harmonics_gradient(const Camera& camera, const RawGaussian& gaussian, const float* v_color,
                                          float (&c)[3 * kBasesOf<kDegree>], RawGradient& to) {
  constexpr int kBases = kBasesOf<kDegree>;
  float direction[3], b[kBases];
  const float inverse = unit_direction(camera, gaussian.mean, direction);
  bases_at<kDegree>(direction[0], direction[1], direction[2], b);
  float v[3];
  for (int j = 0; j < 3; ++j) {
    float color = 0.5f + b[0] * gaussian.color[j];
#pragma unroll
    for (int k = 0; k < kBases; ++k) color += b[k] * c[3 * k + j];
    v[j] = color > 0 ? v_color[j] : 0;
    to.color[j] = b[0] * v[j];
  }
  if constexpr (kDegree > 0) {  // a constant has no direction
    float v_b[kBases] = {}, g[3];
#pragma unroll
    for (int k = 1; k < kBases; ++k) v_b[k] = v[0] * c[3 * k] + v[1] * c[3 * k + 1] + v[2] * c[3 * k + 2];
    bases_backward<kDegree>(direction[0], direction[1], direction[2], v_b, g, g + 1, g + 2);
    const float along = g[0] * direction[0] + g[1] * direction[1] + g[2] * direction[2];
    for (int k = 0; k < 3; ++k) to.mean[k] += (g[k] - along * direction[k]) * inverse;
  }
#pragma unroll
  for (int k = 0; k < kBases; ++k)
    for (int j = 0; j < 3; ++j) c[3 * k + j] = b[k] * v[j];
}

constexpr float kFirstBasis = 0.28209479177387814f;
constexpr float kLeastWeightPx = 0.3f;  // LEAST_WEIGHT_PX in Python

// What to add to the coefficients of degree 0, in place of their gradient, for weighted sums of residuals and the sum of the
// weights; c is what they are without their deltas. A colour below 0 can rise and does not sink further.
__device__ inline void colour_correction(const RawGaussian& gaussian, const float* residuals, float weight, float relaxation,
                                         const float* c, RawGradient& to) {
  for (int j = 0; j < 3; ++j) {
    const float color = 0.5f + kFirstBasis * (gaussian.color[j] + c[j]);
    const float wanted = relaxation * residuals[j] / (weight + kLeastWeightPx);
    to.color[j] = fmaxf(wanted, -fmaxf(color, 0.0f)) / kFirstBasis;
  }
}

}  // namespace

}  // namespace gsplat::frame
