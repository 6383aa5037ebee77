#include "unscented_projection.h"

#include "cuda_scratch.h"
#include "unscented_projection_math.h"

namespace gsplat::unscented_projection {
namespace {

using namespace GSPLAT_ISA::unscented_projection;
namespace projection = GSPLAT_ISA::projection;

__device__ Gaussian load_gaussian(const Inputs& in, int64_t n) {
  float mean[3], quat[4], scale[3];
  for (int k = 0; k < 3; ++k) mean[k] = in.means[3 * n + k], scale[k] = in.scales[3 * n + k];
  for (int k = 0; k < 4; ++k) quat[k] = in.quats[4 * n + k];
  return gaussian_of(mean, quat, scale, in.spread);
}

__global__ void __launch_bounds__(kThreads) forward(Inputs in, Outputs out) {
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x, N = in.size.gaussians;
  if (at >= in.size.batches * in.size.cameras * N) return;
  const int64_t image = at / N, n = image / in.size.cameras * N + at % N;
  float opacity = 0;
  if (in.opacities != nullptr) opacity = in.opacities[n];
  const auto p = project(in, Lens(in, image), load_gaussian(in, n), in.opacities != nullptr ? &opacity : nullptr,
                         out.compensations != nullptr);
  out.radii[2 * at] = p.valid ? int32_t(p.radius_x) : 0;
  out.radii[2 * at + 1] = p.valid ? int32_t(p.radius_y) : 0;
  out.means2d[2 * at] = p.valid ? p.u : 0;
  out.means2d[2 * at + 1] = p.valid ? p.v : 0;
  out.depths[at] = p.valid ? p.depth : 0;
  for (int k = 0; k < 3; ++k) out.conics[3 * at + k] = p.valid ? p.conic[k] : 0;
  if (out.compensations != nullptr) out.compensations[at] = p.valid ? p.compensation : 0;
}

// Compute the gradients of all Gaussians. Each thread has one Gaussian and iterates over the cameras in order.
__global__ void __launch_bounds__(kThreads) backward(Inputs in, Gradients from) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x, N = in.size.gaussians;
  if (n >= in.size.batches * N) return;
  const int64_t batch = n / N;
  const Gaussian gaussian = load_gaussian(in, n);
  GaussianGradient total = {};
  for (int64_t camera = 0; camera < in.size.cameras; ++camera) {
    const int64_t image = batch * in.size.cameras + camera, at = image * N + n % N;
    if (from.radii[2 * at] <= 0) continue;
    projection::ProjectedGradient v = {};
    if (from.means2d != nullptr) v.means2d[0] = from.means2d[2 * at], v.means2d[1] = from.means2d[2 * at + 1];
    if (from.depths != nullptr) v.depth = from.depths[at];
    if (from.conics != nullptr)
      for (int k = 0; k < 3; ++k) v.conic[k] = from.conics[3 * at + k];
    if (from.compensations != nullptr) v.compensation = from.compensations[at];
    const GaussianGradient g = project_backward(in, Lens(in, image), gaussian, v, from.compensations != nullptr);
    for (int k = 0; k < 3; ++k) total.mean[k] += g.mean[k], total.scale[k] += g.scale[k];
    for (int k = 0; k < 4; ++k) total.quat[k] += g.quat[k];
  }
  for (int k = 0; k < 3; ++k) from.v_means[3 * n + k] = total.mean[k], from.v_scales[3 * n + k] = total.scale[k];
  for (int k = 0; k < 4; ++k) from.v_quats[4 * n + k] = total.quat[k];
}

}  // namespace

void project_on_device(const Inputs& in, const Outputs& out, cudaStream_t stream) {
  const int64_t rows = in.size.batches * in.size.cameras * in.size.gaussians;
  if (rows > 0) forward<<<blocks_for(rows), kThreads, 0, stream>>>(in, out);
}

void project_backward_on_device(const Inputs& in, const Gradients& gradients, cudaStream_t stream) {
  const int64_t rows = in.size.batches * in.size.gaussians;
  if (rows > 0) backward<<<blocks_for(rows), kThreads, 0, stream>>>(in, gradients);
}

}  // namespace gsplat::unscented_projection
