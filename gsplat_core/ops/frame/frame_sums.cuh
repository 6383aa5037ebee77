// Sums of counts that stop at the largest 32-bit integer, over warps and blocks.
#pragma once

#include "../compositing/blend_window.cuh"

namespace {

constexpr uint32_t kMost = 0x7fffffffu;  // sums stop here: min(a + b, kMost) is associative

__device__ inline uint32_t add(uint32_t a, uint32_t b) { return min(a + b, kMost); }

// The sums of all threads up to this one and of the whole block. `of_warps` may be used again after the next barrier.
struct BlockSum {
  uint32_t before, all;
};
__device__ inline uint32_t sum_up_to_lane(uint32_t value) {
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAll, value, step);
    if ((threadIdx.x & 31) >= step) value = add(value, before);
  }
  return value;
}
__device__ inline BlockSum sum_over_block(uint32_t value, uint32_t* of_warps) {
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, warps = int(blockDim.x) / 32;
  const uint32_t through = sum_up_to_lane(value), before = __shfl_up_sync(kAll, through, 1);
  if (lane == 31) of_warps[warp] = through;
  __syncthreads();
  // Every warp sums the warps for itself, which saves a barrier.
  const uint32_t sums = sum_up_to_lane(lane < warps ? of_warps[lane] : 0);
  const uint32_t in_front = __shfl_sync(kAll, sums, max(warp - 1, 0));
  return {add(warp > 0 ? in_front : 0, lane > 0 ? before : 0), __shfl_sync(kAll, sums, 31)};
}

}  // namespace
