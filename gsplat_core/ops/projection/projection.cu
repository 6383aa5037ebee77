#include "cuda_scratch.h"
#include "projection.h"
#include "projection_device.cuh"

namespace gsplat::projection {
namespace {

template <int K>
__device__ void load(const float* p, int64_t row, float* v) {
  for (int k = 0; k < K; ++k) v[k] = p[K * row + k];
}
template <int K>
__device__ void store(float* p, int64_t row, const float* v) {
  for (int k = 0; k < K; ++k) p[K * row + k] = v[k];
}

// Project the Gaussians of all images. All threads of a block process the same image.
template <CameraModel model>
__global__ void __launch_bounds__(kThreads) forward(ProjectionInput all, ProjectionSize size, ProjectionOutput out) {
  const int64_t blocks = (size.gaussians + kThreads - 1) / kThreads, image = blockIdx.x / blocks;
  const int64_t n = (blockIdx.x % blocks) * kThreads + threadIdx.x;
  if (n >= size.gaussians) return;
  const ProjectionInput in = of_camera(all, size, image / size.cameras, image % size.cameras);
  const View<model> view(in);
  float mean[3];
  load<3>(in.means, n, mean);
  const bool compensate = out.compensations != nullptr;
  const Projected p =
      project(in, view, mean, load_geometry(in, n), in.opacities != nullptr ? in.opacities + n : nullptr, compensate);
  const int64_t at = image * size.gaussians + n;
  out.radii[2 * at] = p.valid ? int32_t(p.radius_x) : 0;
  out.radii[2 * at + 1] = p.valid ? int32_t(p.radius_y) : 0;
  out.means2d[2 * at] = p.valid ? p.u : 0;
  out.means2d[2 * at + 1] = p.valid ? p.v : 0;
  out.depths[at] = p.valid ? p.depth : 0;
  for (int k = 0; k < 3; ++k) out.conics[3 * at + k] = p.valid ? p.conic[k] : 0;
  if (compensate) out.compensations[at] = p.valid ? p.compensation : 0;
}

// Compute the gradients of all Gaussians. All threads of a block process the same batch: each thread has one Gaussian
// and iterates over the cameras in order.
template <CameraModel model>
__global__ void __launch_bounds__(kThreads)
    backward(ProjectionInput all, ProjectionSize size, ProjectionOutputGradient from, ProjectionInputGradient to) {
  const int64_t blocks = (size.gaussians + kThreads - 1) / kThreads, batch = blockIdx.x / blocks, block = blockIdx.x % blocks;
  const int64_t n = block * kThreads + threadIdx.x;
  BackProjected total = {};
  for (int64_t camera = 0; camera < size.cameras; ++camera) {
    const int64_t image = batch * size.cameras + camera, at = image * size.gaussians + n;
    BackProjected g = {};
    if (n < size.gaussians && from.radii[2 * at] > 0) {
      const ProjectionInput in = of_camera(all, size, batch, camera);
      const View<model> view(in);
      float mean[3];
      load<3>(in.means, n, mean);
      ProjectedGradient v = {};
      if (from.means2d != nullptr) load<2>(from.means2d, at, v.means2d);
      if (from.depths != nullptr) v.depth = from.depths[at];
      if (from.conics != nullptr) load<3>(from.conics, at, v.conic);
      if (from.compensations != nullptr) v.compensation = from.compensations[at];
      g = project_backward(in, view, mean, load_geometry(in, n), v, from.compensations != nullptr, to.viewmat != nullptr);
      for (int k = 0; k < 3; ++k) total.mean[k] += g.mean[k];
      for (int k = 0; k < 6; ++k) total.sigma.v[k] += g.sigma.v[k];
      for (int k = 0; k < 4; ++k) total.quat[k] += g.quat[k];
      for (int k = 0; k < 3; ++k) total.scales[k] += g.scales[k];
    }
    if (to.viewmat != nullptr)
      sum_over_block<kMatrixSums, kThreads>(g.viewmat, to.viewmat + (image * blocks + block) * kMatrixSums);
  }
  if (n >= size.gaussians) return;
  const int64_t row = batch * size.gaussians + n;
  store<3>(to.means, row, total.mean);
  if (all.covars != nullptr) {
    store<6>(to.covars, row, total.sigma.v);
  } else {
    store<4>(to.quats, row, total.quat);
    store<3>(to.scales, row, total.scales);
  }
}

}  // namespace

void project_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutput& out, cudaStream_t stream) {
  const int64_t blocks = size.batches * size.cameras * blocks_for(size.gaussians);
  if (blocks == 0) return;
  const auto kernel = in.model == kOrtho ? forward<kOrtho> : in.model == kFisheye ? forward<kFisheye> : forward<kPinhole>;
  kernel<<<unsigned(blocks), kThreads, 0, stream>>>(in, size, out);
}

int64_t camera_sums(const ProjectionSize& size) { return size.batches * size.cameras * blocks_for(size.gaussians); }

void project_backward_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutputGradient& from,
                                const ProjectionInputGradient& to, float* v_viewmats, cudaStream_t stream) {
  const int64_t per_image = blocks_for(size.gaussians), blocks = size.batches * per_image;
  if (blocks == 0) return;
  const auto kernel = in.model == kOrtho ? backward<kOrtho> : in.model == kFisheye ? backward<kFisheye> : backward<kPinhole>;
  kernel<<<unsigned(blocks), kThreads, 0, stream>>>(in, size, from, to);
  const int64_t images = size.batches * size.cameras;
  if (to.viewmat != nullptr && images > 0)
    sum_over_blocks<kMatrixSums><<<unsigned(images), 32 * kMatrixSums, 0, stream>>>(to.viewmat, per_image, v_viewmats, nullptr);
}

}  // namespace gsplat::projection
