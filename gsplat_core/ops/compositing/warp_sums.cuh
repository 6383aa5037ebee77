// Sums of several values over the lanes of a warp.
#pragma once

#include "../blending/splats.cuh"

namespace gsplat::compositing {
namespace {

using blending::kAll;

// Sum 2 kHalf values over groups of 4 kHalf lanes with one shuffle per value: a lane sends half of its values, then
// half of the remaining ones. For 16 values lane i of the warp returns the sum of value i / 2.
template <int kHalf>
__device__ inline float warp_sums(float* v, int lane) {
  if constexpr (kHalf == 0) {
    return v[0] + __shfl_xor_sync(kAll, v[0], 1);
  } else {
    const bool upper = (lane & 2 * kHalf) != 0;
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float low = v[i], high = v[i + kHalf];
      v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, 2 * kHalf);
    }
    return warp_sums<kHalf / 2>(v, lane);
  }
}

}  // namespace
}  // namespace gsplat::compositing
