#include "cuda_scratch.h"
#include "densification.h"
#include "densification_math.h"

namespace gsplat::densification {
namespace {

__global__ void __launch_bounds__(kThreads) accumulate(const Statistics s) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= s.count) return;
  float sum = 0, seen = 0;
  int widest = 0;
  for (int64_t image = 0; image < s.images; ++image) {
    const int64_t at = 2 * (image * s.count + i);
    const int across = s.radii[at], down = s.radii[at + 1];
    if (across <= 0 || down <= 0) continue;
    const float x = s.gradients[at] * s.scale_x, y = s.gradients[at + 1] * s.scale_y;
    sum += sqrtf(x * x + y * y);
    seen += 1;
    widest = max(widest, max(across, down));
  }
  s.sums[i] += sum;
  s.counts[i] += seen;
  if (s.largest != nullptr) s.largest[i] = fmaxf(s.largest[i], float(widest) * s.extent_scale);
}

__global__ void __launch_bounds__(kThreads) diffuse(const Diffusion d, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  float mean[3], quat[4], log_scales[3], noise[3];
  for (int k = 0; k < 4; ++k) quat[k] = d.quats[4 * i + k];
  for (int k = 0; k < 3; ++k) {
    mean[k] = d.means[3 * i + k];
    log_scales[k] = d.log_scales[3 * i + k];
    noise[k] = d.noise[3 * i + k];
  }
  GSPLAT_ISA::densification::diffused(mean, quat, log_scales, d.logits[i], noise, d.scale, d.opacity_at_half, d.steepness);
  for (int k = 0; k < 3; ++k) d.means[3 * i + k] = mean[k];
}

}  // namespace

void accumulate_on_device(const Statistics& s, cudaStream_t stream) {
  if (s.count == 0) return;
  accumulate<<<blocks_for(s.count), kThreads, 0, stream>>>(s);
}

void diffuse_on_device(const Diffusion& d, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  diffuse<<<blocks_for(count), kThreads, 0, stream>>>(d, count);
}

}  // namespace gsplat::densification
