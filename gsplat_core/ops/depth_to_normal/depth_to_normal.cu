// Normals of depth maps with one thread per pixel. The gradient of a depth gathers those of the neighbours' normals.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "depth_to_normal_math.h"

namespace gsplat::depth_to_normal {
namespace {

using namespace GSPLAT_ISA::depth_to_normal;

template <class Work>
__device__ inline void for_own_pixel(const Maps& maps, const Work& work) {
  const int64_t pixels = int64_t(maps.height) * maps.width, at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (at >= maps.images * pixels) return;
  const int64_t image = at / pixels, inside = at % pixels;
  work(view_of(maps, image), image, int(inside % maps.width), int(inside / maps.width));
}

__global__ void __launch_bounds__(kThreads) normals(Maps maps, float* out) {
  for_own_pixel(maps, [&](const View& view, int64_t image, int x, int y) { write_normal(maps, view, image, x, y, out); });
}

__global__ void __launch_bounds__(kThreads) gradients(Maps maps, const float* v_normals, float* v_depths) {
  for_own_pixel(
      maps, [&](const View& view, int64_t image, int x, int y) { write_gradient(maps, view, image, x, y, v_normals, v_depths); });
}

int64_t pixels_of(const Maps& maps) { return maps.images * maps.height * maps.width; }

}  // namespace

void normals_on_device(const Maps& maps, float* out, cudaStream_t stream) {
  normals<<<blocks_for(pixels_of(maps)), kThreads, 0, stream>>>(maps, out);
}

void gradients_on_device(const Maps& maps, const float* v_normals, float* v_depths, cudaStream_t stream) {
  gradients<<<blocks_for(pixels_of(maps)), kThreads, 0, stream>>>(maps, v_normals, v_depths);
}

}  // namespace gsplat::depth_to_normal
