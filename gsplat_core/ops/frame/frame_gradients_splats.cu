// Per Gaussian: the sum of its rows, and from there to the gradient of its raw parameters.
#include <type_traits>

#include "frame_gradients_warp.cuh"

namespace {

template <int kDegree>
__global__ void __launch_bounds__(kSplatThreads<kDegree>)
    gradients_of_splats(FrameScene scene, FrameLists lists, FrameGradients from, RawGradients to) {
  __shared__ WarpGradients<kDegree> warps[kSplatThreads<kDegree> / 32];
  __shared__ FrameCamera camera;
  load_camera(scene, camera);
  const int lane = threadIdx.x & 31;
  const int64_t first = int64_t(blockIdx.x) * kSplatThreads<kDegree> + threadIdx.x / 32 * 32;
  if (first >= scene.count) return;
  const int count = int(scene.count - first < 32 ? scene.count - first : 32);
  WarpGradients<kDegree>& warp = warps[threadIdx.x / 32];
  warp.compute(scene, camera, lists, from, first, count, lane);
  __syncwarp();
  write_rows(warp.raw, to.raw + first * kRawColumns, count, lane);
  if (to.sh != nullptr) write_rows(warp.sh, to.sh + first * warp.kHarmonics, count, lane);
}

}  // namespace

void splat_gradients_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                               const RawGradients& to, cudaStream_t stream) {
  if (scene.count == 0) return;
  with_degree(scene.bases, [&](auto degree) {
    constexpr int kDegree = decltype(degree)::value, kBlock = kSplatThreads<kDegree>;
    gradients_of_splats<kDegree><<<blocks_for(scene.count, kBlock), kBlock, 0, stream>>>(scene, lists, from, to);
  });
}
