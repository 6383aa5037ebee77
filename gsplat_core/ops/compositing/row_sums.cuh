// Sums of the gradient rows of each splat, for ops that convert the sums to gradients in a kernel of their own.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "cuda_scratch.h"

namespace gsplat::compositing {
namespace {

// Sum the rows of each splat in list order, one thread per splat and value. An instance (a splat in a tile) has a row of
// `row_size` floats per window of its tile; `positions` and `ranges` are those of `Instances`.
__global__ void sum_rows(int64_t count, const uint32_t* positions, const uint2* ranges, const float* rows, int windows,
                         int row_size, float* sums) {
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x, splat = e / row_size, value = e % row_size;
  if (splat >= count) return;
  const uint2 range = ranges[splat];
  float total = 0;
  for (uint32_t i = range.x; i < range.y; ++i)
    for (int part = 0; part < windows; ++part) total += rows[(int64_t(positions[i]) * windows + part) * row_size + value];
  sums[e] = total;
}

}  // namespace
}  // namespace gsplat::compositing
