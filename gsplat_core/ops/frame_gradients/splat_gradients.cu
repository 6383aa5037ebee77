// Sums each Gaussian's gradient rows, and applies the chain rule to its raw parameters.
#include "warp_rows.cuh"

namespace gsplat::frame {
namespace {

template <int kDegree>
__global__ void __launch_bounds__(kSplatThreads<kDegree>)
    backward_splats(Scene scene, Lists lists, PictureGradient from, RawGradients to) {
  __shared__ WarpGradients<kDegree> warps[kSplatThreads<kDegree> / 32];
  __shared__ Camera camera;
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

void splat_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to,
                     cudaStream_t stream) {
  if (scene.count == 0) return;
  with_degree(scene.bases, [&](auto degree) {
    constexpr int kDegree = decltype(degree)::value, kBlock = kSplatThreads<kDegree>;
    backward_splats<kDegree><<<blocks_for(scene.count, kBlock), kBlock, 0, stream>>>(scene, lists, from, to);
  });
}

}  // namespace gsplat::frame
