// From the sum of a Gaussian's rows to the gradient of its raw parameters, one Gaussian per thread.
#pragma once

#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "frame_gaussian.cuh"
#include "frame_gradients_cuda.h"

namespace {

using namespace GSPLAT_ISA;

// The sum of a Gaussian's rows.
struct SplatRow {
  float moments[6];  // sums over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha
  float colors[4];   // red, green, blue, z
};

// The gradient of a Gaussian's raw parameters, in the order of kRawColumns.
struct RawGradient {
  float mean[3], quat[4], log_scales[3], color[3], logit;
};

template <CameraModel model>
__device__ inline RawGradient projection_gradient(const FrameScene& scene, const FrameCamera& camera, const RawGaussian& gaussian,
                                                  const SplatRow& sum) {
  const ProjectionInput in = projection_input(scene, camera);
  const View<model> view(in);
  const Geometry geometry = geometry_of(gaussian);
  const Ellipse e = ellipse_of(view, Projector<model>::forward(view.k, view.to_camera(gaussian.mean)), geometry.sigma);
  const float a = e.a0 + scene.eps2d, c = e.c0 + scene.eps2d, inverse = 1.0f / (a * c - e.b * e.b);
  const float conic[3] = {c * inverse, -e.b * inverse, a * inverse};
  const float* const m = sum.moments;
  const ProjectedGradient v = {{conic[0] * m[1] + conic[1] * m[2], conic[1] * m[1] + conic[2] * m[2]},
                               sum.colors[3],
                               {-0.5f * m[3], -m[4], -0.5f * m[5]},
                               0};
  const BackProjected back = project_backward(in, view, gaussian.mean, geometry, v, false, false);
  RawGradient to = {};
  for (int k = 0; k < 3; ++k) to.mean[k] = back.mean[k];
  for (int k = 0; k < 4; ++k) to.quat[k] = back.quat[k];
  for (int k = 0; k < 3; ++k) to.log_scales[k] = back.scales[k] * geometry.scales[k];
  to.logit = m[0] * (1 - opacity_of(gaussian));  // dL/dlogit = o (1 - o) dL/do, and the first moment is o dL/do
  return to;
}

__device__ inline RawGradient projection_gradient(const FrameScene& scene, const FrameCamera& camera, const RawGaussian& gaussian,
                                                  const SplatRow& sum) {
  switch (scene.camera_model) {
    case kOrtho: return projection_gradient<kOrtho>(scene, camera, gaussian, sum);
    case kFisheye: return projection_gradient<kFisheye>(scene, camera, gaussian, sum);
    default: return projection_gradient<kPinhole>(scene, camera, gaussian, sum);
  }
}

template <int kDegree>
constexpr int kBasesOf = (kDegree + 1) * (kDegree + 1);

// The colour's way back: to the direction, and so to the mean, and to the coefficients c, which their gradient replaces. A
// channel that was raised to zero passes nothing on.
template <int kDegree>
__device__ inline void harmonics_gradient(const FrameCamera& camera, const RawGaussian& gaussian, const float* v_color,
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

}  // namespace
