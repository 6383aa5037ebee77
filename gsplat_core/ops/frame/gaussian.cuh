// Raw parameters of one Gaussian; the first step of the forward pass and of the gradient.
#pragma once

#include "../projection/projection_math.h"
#include "../spherical_harmonics/staged_harmonics.cuh"
#include "frame.h"

namespace gsplat::frame {
namespace {

using namespace GSPLAT_ISA::projection;
using namespace spherical_harmonics;

// The camera in shared memory. Its matrices are read from device memory, so that a captured graph uses the current
// values.
struct Camera {
  float viewmat[16], intrinsics[9], center[3];
};

// Load the camera; its centre is -R^T t. All threads of a block of at least 32 must call it. Ends with a barrier.
__device__ inline void load_camera(const Scene& in, Camera& camera) {
  const int i = threadIdx.x;
  if (i < 16) camera.viewmat[i] = in.viewmat[i];
  if (i >= 16 && i < 25) camera.intrinsics[i - 16] = in.intrinsics[i - 16];
  if (i >= 25 && i < 28) {
    float sum = 0;
    for (int row = 0; row < 3; ++row) sum = fmaf(-in.viewmat[4 * row + i - 25], in.viewmat[4 * row + 3], sum);
    camera.center[i - 25] = sum;
  }
  __syncthreads();
}

__device__ inline ProjectionInput projection_input(const Scene& in, const Camera& camera) {
  ProjectionInput p = {};
  p.viewmat = camera.viewmat;
  p.intrinsics = camera.intrinsics;
  p.width = float(in.width);
  p.height = float(in.height);
  p.eps2d = in.eps2d;
  p.near_plane = in.near_plane;
  p.far_plane = in.far_plane;
  p.model = CameraModel(in.camera_model);
  return p;
}

// Raw parameters plus deltas. A Gaussian is usable if all of them are finite.
struct RawGaussian {
  float mean[3], quat[4], log_scale[3], color[3], logit;  // color: delta of the first coefficient only
  bool usable;
};

__device__ inline float4 load_four(const float* p, bool aligned) {
  return aligned ? *reinterpret_cast<const float4*>(p) : make_float4(p[0], p[1], p[2], p[3]);
}

__device__ inline RawGaussian load_gaussian(const Scene& in, int64_t n) {
  RawGaussian g;
  const float4 quat = load_four(in.quats + 4 * n, in.aligned);
  const float4 zero = make_float4(0, 0, 0, 0);
  float4 d[kRawColumns / 4] = {zero, zero, zero, zero};
  if (in.deltas != nullptr)
    for (int k = 0; k < kRawColumns / 4; ++k) d[k] = load_four(in.deltas + kRawColumns * n + 4 * k, in.aligned);
  const float delta[kRawUsed] = {d[0].x, d[0].y, d[0].z, d[0].w, d[1].x, d[1].y, d[1].z,
                                 d[1].w, d[2].x, d[2].y, d[2].z, d[2].w, d[3].x, d[3].y};
  const float q[4] = {quat.x, quat.y, quat.z, quat.w};
  for (int k = 0; k < 3; ++k) g.mean[k] = in.means[3 * n + k] + delta[kRawPosition + k];
  for (int k = 0; k < 4; ++k) g.quat[k] = q[k] + delta[kRawRotation + k];
  for (int k = 0; k < 3; ++k) g.log_scale[k] = in.log_scales[3 * n + k] + delta[kRawLogScale + k];
  for (int k = 0; k < 3; ++k) g.color[k] = delta[kRawColor + k];
  g.logit = in.logit_opacities[n] + delta[kRawOpacity];
  // 0 times a non-finite value is NaN, so the sum is NaN if any value is not finite.
  float sum = 0 * g.logit;
  for (int k = 0; k < 3; ++k) sum += 0 * g.mean[k] + 0 * g.log_scale[k] + 0 * g.color[k];
  for (int k = 0; k < 4; ++k) sum += 0 * g.quat[k];
  g.usable = sum == 0;
  return g;
}

__device__ inline float opacity_of(const RawGaussian& g) { return 1.0f / (1.0f + expf(-g.logit)); }

__device__ inline Geometry geometry_of(const RawGaussian& g) {
  const float scales[3] = {expf(g.log_scale[0]), expf(g.log_scale[1]), expf(g.log_scale[2])};
  return GSPLAT_ISA::projection::geometry_of(g.quat, scales);
}

}  // namespace

}  // namespace gsplat::frame
