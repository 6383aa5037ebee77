// Chain rule from the sum of a Gaussian's gradient rows to the gradient of its raw parameters, one Gaussian per thread.
#pragma once

#include "../frame/gaussian.cuh"
#include "../projection/projection_device.cuh"
#include "frame_gradients.h"

namespace gsplat::frame {
namespace {

using projection::ellipse_gradient;
using projection::EllipseGradient;

// Sum of a Gaussian's gradient rows over the tiles that it touches.
struct SplatRow {
  float moments[6];  // sums over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha
  float colors[4];   // dL/d(red, green, blue, z); for colour corrections weighted residuals and the sum of weights
};

// Gradient of a Gaussian's raw parameters.
struct RawGradient {
  float mean[3], quat[4], log_scales[3], color[3], logit;
};

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
  to.logit = sum.moments[0] * (1 - opacity_of(gaussian));  // dL/dlogit = o (1 - o) dL/do, and the first moment equals o dL/do
  return to;
}

__device__ inline RawGradient projection_gradient(const Scene& scene, const Camera& camera, const RawGaussian& gaussian,
                                                  const SplatRow& sum) {
  return with_camera_model(scene.camera_model,
                           [&](auto model) { return projection_gradient<decltype(model)::value>(scene, camera, gaussian, sum); });
}

// Chain rule of the colour: to the view direction and through it to the mean, and to the coefficients c, which are
// replaced by their gradient. A channel clamped at zero has no gradient.
template <int kDegree>
__device__ inline void harmonics_gradient(const Camera& camera, const RawGaussian& gaussian, const float* v_color,
                                          float (&c)[3 * kBasesOf<kDegree>], RawGradient& to) {
  constexpr int kBases = kBasesOf<kDegree>;
  float direction[3], b[kBases];
  const float inverse = unit_direction(camera.center, gaussian.mean, direction);
  bases_at<kDegree>(direction[0], direction[1], direction[2], b);
  float v[3];
  for (int j = 0; j < 3; ++j) {
    float color = 0.5f + b[0] * gaussian.color[j];
#pragma unroll
    for (int k = 0; k < kBases; ++k) color += b[k] * c[3 * k + j];
    v[j] = color > 0 ? v_color[j] : 0;
    to.color[j] = b[0] * v[j];
  }
  if constexpr (kDegree > 0) {  // degree 0 does not depend on the direction
    float v_mean[3];
    direction_gradient<kDegree>(direction, inverse, c, v, v_mean);
    for (int k = 0; k < 3; ++k) to.mean[k] += v_mean[k];
  }
#pragma unroll
  for (int k = 0; k < kBases; ++k)
    for (int j = 0; j < 3; ++j) c[3 * k + j] = b[k] * v[j];
}

constexpr float kFirstBasis = 0.28209479177387814f;
constexpr float kLeastWeightPx = 0.3f;  // LEAST_WEIGHT_PX in Python

// Corrections to add to the coefficients of degree 0, in place of their gradient, from weighted sums of residuals and
// the sum of the weights. c are the coefficients without deltas. A colour below 0 can increase but is not decreased
// further.
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
