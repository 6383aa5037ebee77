#include "splat_rays.h"

#include "cuda_scratch.h"
#include "splat_rays_math.h"

namespace gsplat::splat_rays {
namespace {

using namespace GSPLAT_ISA::splat_rays;

__device__ State load_state(const Inputs& in, const View& view, int64_t i) {
  float mean[3], q[4], scale[3];
  for (int k = 0; k < 3; ++k) mean[k] = in.means[3 * i + k], scale[k] = in.scales[3 * i + k];
  for (int k = 0; k < 4; ++k) q[k] = in.quats[4 * i + k];
  return state_of(view, mean, q, scale);
}

__global__ void __launch_bounds__(kThreads) forward(Inputs in, float* rays, float* normals) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  float ray[10], normal[3];
  rays_of(load_state(in, view_of(in.viewmat, in.K), i), ray, normal);
  for (int k = 0; k < 10; ++k) rays[10 * i + k] = ray[k];
  for (int k = 0; k < 3; ++k) normals[3 * i + k] = normal[k];
}

__global__ void __launch_bounds__(kThreads) backward(Inputs in, Gradients g) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const View view = view_of(in.viewmat, in.K);
  float v_ray[10], v_normal[3], v_mean[3], v_quat[4], v_scale[3];
  for (int k = 0; k < 10; ++k) v_ray[k] = g.v_rays[10 * i + k];
  for (int k = 0; k < 3; ++k) v_normal[k] = g.v_normals[3 * i + k];
  rays_backward(view, load_state(in, view, i), v_ray, v_normal, v_mean, v_quat, v_scale);
  for (int k = 0; k < 3; ++k) g.v_means[3 * i + k] = v_mean[k], g.v_scales[3 * i + k] = v_scale[k];
  for (int k = 0; k < 4; ++k) g.v_quats[4 * i + k] = v_quat[k];
}

}  // namespace

void forward_on_device(const Inputs& in, float* rays, float* normals, cudaStream_t stream) {
  if (in.count > 0) forward<<<blocks_for(in.count), kThreads, 0, stream>>>(in, rays, normals);
}

void backward_on_device(const Inputs& in, const Gradients& gradients, cudaStream_t stream) {
  if (in.count > 0) backward<<<blocks_for(in.count), kThreads, 0, stream>>>(in, gradients);
}

}  // namespace gsplat::splat_rays
