// The paths along rows and columns, processed concurrently with one warp each. Each direction writes its messages to
// its own volume.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "volume.cuh"

namespace gsplat::stereo_matching {
namespace {

constexpr int kAhead = 8;  // pixels whose costs are prefetched
// Threads per block. Paths are few and long, so small blocks spread them over all multiprocessors.
constexpr int kPathThreads = 64;

// Index of a path's first pixel, and the step to the index of the next.
struct Path {
  int64_t begin, step;
  int length;
  bool exists;
};

__device__ inline Path path_of(const Pair& pair, int direction, int line) {
  const bool along_row = direction < 2, reversed = direction % 2 == 1;
  const int64_t across = along_row ? pair.width : 1, along = along_row ? 1 : pair.width;
  const int length = along_row ? pair.width : pair.height, lines = along_row ? pair.height : pair.width;
  const int64_t first = line * across;
  return {reversed ? first + (length - 1) * along : first, reversed ? -along : along, length, line < lines};
}

template <int kEach>
__global__ void __launch_bounds__(kPathThreads) follow(Pair pair, const uint8_t* costs, uint8_t* messages) {
  using Bytes = typename Packed<kEach>::type;
  const int lane = threadIdx.x % 32, line = int(blockIdx.x) * (kPathThreads / 32) + threadIdx.x / 32;
  const Path path = path_of(pair, blockIdx.y, line);
  if (!path.exists) return;
  const bool used = lane * kEach < pair.count;
  const int64_t volume = int64_t(pair.height) * pair.width * pair.count;
  const int64_t begin = path.begin * pair.count + lane * kEach, step = path.step * pair.count;
  const Bytes* __restrict__ const from = reinterpret_cast<const Bytes*>(costs + begin);
  Bytes* __restrict__ const to = reinterpret_cast<Bytes*>(messages + blockIdx.y * volume + begin);
  const int64_t hop = step / kEach;  // exact, because the number of disparities is a multiple of 16
  // Cost of each disparity above the best one, at most kLargeStep. Initially 0 for every disparity.
  int kept[kEach];
#pragma unroll
  for (int k = 0; k < kEach; ++k) kept[k] = used ? 0 : kLargeStep;
  Bytes next[kAhead];
#pragma unroll
  for (int i = 0; i < kAhead; ++i) next[i] = used && i < path.length ? from[i * hop] : Bytes(0);
  for (int first = 0; first < path.length; first += kAhead) {
    Bytes now[kAhead];
#pragma unroll
    for (int i = 0; i < kAhead; ++i) {
      now[i] = next[i];
      const int later = first + kAhead + i;
      next[i] = used && later < path.length ? from[later * hop] : Bytes(0);
    }
#pragma unroll
    for (int i = 0; i < kAhead; ++i) {
      if (first + i >= path.length) break;
      const int last_below = __shfl_up_sync(kAllLanes, kept[kEach - 1], 1), first_above = __shfl_down_sync(kAllLanes, kept[0], 1);
      const int below = lane == 0 ? kLargeStep : last_below, above = lane == 31 ? kLargeStep : first_above;
      int total[kEach], least = INT_MAX;
      Bytes packed = 0;
#pragma unroll
      for (int k = 0; k < kEach; ++k) {
        const int beside = min(k == 0 ? below : kept[k - 1], k == kEach - 1 ? above : kept[k + 1]) + kSmallStep;
        const int message = min(kept[k], beside);
        packed |= Bytes(message) << (8 * k);
        total[k] = byte_of<kEach>(now[i], k) + message;
        least = min(least, total[k]);
      }
      const int best = __reduce_min_sync(kAllLanes, used ? least : INT_MAX);
#pragma unroll
      for (int k = 0; k < kEach; ++k) kept[k] = used ? min(total[k] - best, kLargeStep) : kLargeStep;
      if (used) to[(first + i) * hop] = packed;
    }
  }
}

}  // namespace

void follow_paths(const Pair& pair, const uint8_t* costs, uint8_t* messages, cudaStream_t stream) {
  const dim3 blocks(blocks_for(pair.height > pair.width ? pair.height : pair.width, kPathThreads / 32), kPaths);
  with_each(pair.count, [&](auto each) { follow<each.value><<<blocks, kPathThreads, 0, stream>>>(pair, costs, messages); });
}

}  // namespace gsplat::stereo_matching
