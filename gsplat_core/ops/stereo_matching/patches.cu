// Removes small patches of disparities. Each pixel is linked with its neighbours of similar disparity. The label of a
// patch is the index of its first pixel, whatever the order in which threads link pixels.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "volume.cuh"

namespace gsplat::stereo_matching {
namespace {

__device__ inline int root_of(const volatile int32_t* parents, int i) {
  for (int parent = parents[i]; parent != i; parent = parents[i]) i = parent;
  return i;
}

__global__ void __launch_bounds__(kThreads) begin_patches(int pixels, int32_t* parents, int32_t* sizes) {
  const int i = int(blockIdx.x) * kThreads + threadIdx.x;
  if (i < pixels) parents[i] = i, sizes[i] = 0;
}

__device__ inline void link(const int32_t* sixteenths, int32_t* parents, int a, int b) {
  const int here = sixteenths[a], there = sixteenths[b];
  if (here == kUnknown || there == kUnknown || abs(here - there) > kPatchStep) return;
  // Make the earlier root the parent of the later one. If another thread has changed the later root's parent, link the
  // value that it wrote.
  while (true) {
    a = root_of(parents, a), b = root_of(parents, b);
    if (a == b) return;
    const int later = max(a, b), earlier = min(a, b), was = atomicMin(parents + later, earlier);
    if (was == later) return;
    a = was, b = earlier;
  }
}

__global__ void __launch_bounds__(kThreads) link_pixels(int pixels, int width, const int32_t* sixteenths, int32_t* parents) {
  const int i = int(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= pixels) return;
  if (i % width > 0) link(sixteenths, parents, i, i - 1);
  if (i >= width) link(sixteenths, parents, i, i - width);
}

__global__ void __launch_bounds__(kThreads) count_pixels(int pixels, int32_t* parents, int32_t* sizes) {
  const int i = int(blockIdx.x) * kThreads + threadIdx.x;
  const int root = i < pixels ? root_of(parents, i) : -1;
  // One addition for all lanes of a warp in the same patch, because most patches are large.
  const unsigned together = __match_any_sync(kAllLanes, root);
  if (root >= 0 && __ffs(int(together)) - 1 == int(threadIdx.x % 32)) atomicAdd(sizes + root, __popc(together));
  if (root >= 0) parents[i] = root;
}

__global__ void __launch_bounds__(kThreads)
    drop_small(int pixels, const int32_t* parents, const int32_t* sizes, int32_t* sixteenths) {
  const int i = int(blockIdx.x) * kThreads + threadIdx.x;
  if (i < pixels && sizes[parents[i]] <= kPatchPixels) sixteenths[i] = kUnknown;
}

}  // namespace

void drop_patches(const Pair& pair, int32_t* sixteenths, CudaScratch& scratch, cudaStream_t stream) {
  const int pixels = pair.height * pair.width;
  const unsigned blocks = blocks_for(pixels);
  int32_t *const parents = scratch.array<int32_t>(pixels), *const sizes = scratch.array<int32_t>(pixels);
  begin_patches<<<blocks, kThreads, 0, stream>>>(pixels, parents, sizes);
  link_pixels<<<blocks, kThreads, 0, stream>>>(pixels, pair.width, sixteenths, parents);
  count_pixels<<<blocks, kThreads, 0, stream>>>(pixels, parents, sizes);
  drop_small<<<blocks, kThreads, 0, stream>>>(pixels, parents, sizes, sixteenths);
}

}  // namespace gsplat::stereo_matching
