#include "../projection/projection_device.cuh"
#include "cuda_scratch.h"
#include "surfel_projection.h"
#include "surfel_projection_math.h"

namespace gsplat::surfel_projection {
namespace {

namespace math = GSPLAT_ISA::surfel_projection;

template <int K>
__device__ void load(const float* p, int64_t row, float* v) {
  for (int k = 0; k < K; ++k) v[k] = p[K * row + k];
}
template <int K>
__device__ void store(float* p, int64_t row, const float* v, bool valid = true) {
  for (int k = 0; k < K; ++k) p[K * row + k] = valid ? v[k] : 0;
}

// Project the surfels of all images. All threads of a block process the same image.
__global__ void __launch_bounds__(kThreads) forward(Inputs all, Size size, Outputs out) {
  const int64_t blocks = (size.surfels + kThreads - 1) / kThreads, image = blockIdx.x / blocks;
  const int64_t n = (blockIdx.x % blocks) * kThreads + threadIdx.x;
  if (n >= size.surfels) return;
  const Inputs in = of_camera(all, size, image / size.cameras, image % size.cameras);
  const math::View view(in);
  float mean[3], quat[4], scales[3];
  load<3>(in.means, n, mean);
  load<4>(in.quats, n, quat);
  load<3>(in.scales, n, scales);
  const math::Projected p = math::project(in, view, mean, quat, scales);
  const int64_t at = image * size.surfels + n;
  for (int a = 0; a < 2; ++a) out.radii[2 * at + a] = p.valid ? int32_t(p.radii[a]) : 0;
  store<2>(out.means2d, at, p.mean2d, p.valid);
  store<1>(out.depths, at, &p.depth, p.valid);
  store<9>(out.ray_transforms, at, p.transform, p.valid);
  store<3>(out.normals, at, p.normal, p.valid);
}

// Compute the gradients of all surfels. All threads of a block process the same batch: each thread has one surfel and
// iterates over the cameras in order.
__global__ void __launch_bounds__(kThreads) backward(Inputs all, Size size, OutputGradients from, InputGradients to) {
  const int64_t blocks = (size.surfels + kThreads - 1) / kThreads, batch = blockIdx.x / blocks, block = blockIdx.x % blocks;
  const int64_t n = block * kThreads + threadIdx.x;
  math::BackProjected total = {};
  for (int64_t camera = 0; camera < size.cameras; ++camera) {
    const int64_t image = batch * size.cameras + camera, at = image * size.surfels + n;
    math::BackProjected g = {};
    if (n < size.surfels && from.radii[2 * at] > 0) {
      const Inputs in = of_camera(all, size, batch, camera);
      const math::View view(in);
      float mean[3], quat[4], scales[3];
      load<3>(in.means, n, mean);
      load<4>(in.quats, n, quat);
      load<3>(in.scales, n, scales);
      math::ProjectedGradient v = {};
      if (from.means2d != nullptr) load<2>(from.means2d, at, v.mean2d);
      if (from.depths != nullptr) v.depth = from.depths[at];
      if (from.ray_transforms != nullptr) load<9>(from.ray_transforms, at, v.transform);
      if (from.normals != nullptr) load<3>(from.normals, at, v.normal);
      g = math::project_backward(view, mean, quat, scales, v);
      for (int k = 0; k < 3; ++k) total.mean[k] += g.mean[k];
      for (int k = 0; k < 4; ++k) total.quat[k] += g.quat[k];
      for (int k = 0; k < 3; ++k) total.scales[k] += g.scales[k];
    }
    if (to.viewmat != nullptr)
      projection::sum_over_block<kMatrixSums, kThreads>(g.viewmat, to.viewmat + (image * blocks + block) * kMatrixSums);
  }
  if (n >= size.surfels) return;
  const int64_t row = batch * size.surfels + n;
  store<3>(to.means, row, total.mean);
  store<4>(to.quats, row, total.quat);
  store<3>(to.scales, row, total.scales);
}

}  // namespace

void project_on_device(const Inputs& in, const Size& size, const Outputs& out, cudaStream_t stream) {
  const int64_t blocks = size.batches * size.cameras * blocks_for(size.surfels);
  if (blocks == 0) return;
  forward<<<unsigned(blocks), kThreads, 0, stream>>>(in, size, out);
}

int64_t camera_sums(const Size& size) { return size.batches * size.cameras * blocks_for(size.surfels); }

void project_backward_on_device(const Inputs& in, const Size& size, const OutputGradients& from, const InputGradients& to,
                                float* v_viewmats, cudaStream_t stream) {
  const int64_t per_image = blocks_for(size.surfels), blocks = size.batches * per_image;
  if (blocks == 0) return;
  backward<<<unsigned(blocks), kThreads, 0, stream>>>(in, size, from, to);
  const int64_t images = size.batches * size.cameras;
  if (to.viewmat != nullptr && images > 0)
    projection::sum_over_blocks<kMatrixSums>
        <<<unsigned(images), 32 * kMatrixSums, 0, stream>>>(to.viewmat, per_image, v_viewmats, nullptr);
}

}  // namespace gsplat::surfel_projection
