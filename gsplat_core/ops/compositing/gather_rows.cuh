// Sums of the instances' gradient rows per splat, in list order, converted to gradients.
#pragma once

#include "../blending/blend_backward.cuh"
#include "composite_windows.cuh"
#include "cub_device.cuh"
#include "cuda_check.h"

namespace gsplat::compositing {
namespace {

__global__ void number_instances(Inputs in, uint32_t* splats, uint32_t* positions) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.instances) return;
  const uint32_t id = uint32_t(in.flatten_ids[i]);
  splats[i] = id < uint64_t(in.count) ? id : uint32_t(in.count);
  positions[i] = uint32_t(i);
}

// Write the range [x, y) of each splat among the instances sorted by splat. `ranges` must be zeroed, for splats without
// instances.
__global__ void ranges_of_splats(Inputs in, const uint32_t* sorted, uint2* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.instances || sorted[i] >= in.count) return;
  if (i == 0 || sorted[i - 1] != sorted[i]) ranges[sorted[i]].x = uint32_t(i);
  if (i + 1 == in.instances || sorted[i + 1] != sorted[i]) ranges[sorted[i]].y = uint32_t(i + 1);
}

__device__ inline float4 plus(const float4& a, const float4& b) {
  return make_float4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w);
}
__device__ inline float4 from_lane_xor(const float4& v, int mask) {
  return make_float4(__shfl_xor_sync(kAll, v.x, mask), __shfl_xor_sync(kAll, v.y, mask), __shfl_xor_sync(kAll, v.z, mask),
                     __shfl_xor_sync(kAll, v.w, mask));
}

// Sum the rows of each splat and convert the sums to gradients. Four lanes process a splat, one float4 of the row each.
// The whole warp sums a splat with very many rows; the order of additions depends only on their number.
template <int D>
__global__ void gather_rows(Inputs in, const Record<D>* records, const uint32_t* positions, const uint2* ranges,
                            const float4* rows, int windows, int shape, InputGradients out) {
  constexpr int64_t kManyRows = 64;
  const int64_t splat = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / 4;
  const int lane = threadIdx.x & 31, quads = quads_of(shape, in.channels);
  const bool usable = splat < in.count && records[splat].l > -INFINITY;
  const uint2 range = usable ? ranges[splat] : make_uint2(0, 0);
  const int64_t count = int64_t(range.y - range.x) * windows;
  const auto row = [&](uint32_t first, int64_t i, int q) {
    return windows == 1 ? rows[int64_t(positions[first + i]) * quads + q]
                        : rows[(int64_t(positions[first + i / windows]) * windows + i % windows) * quads + q];
  };
  const unsigned large = __ballot_sync(kAll, count > kManyRows && lane % 4 == 0);
  for (int first_quad = 0; first_quad < quads; first_quad += 4) {
    const int q = first_quad + lane % 4;
    float4 sum = make_float4(0, 0, 0, 0);
    if (q < quads && count <= kManyRows) {
#pragma unroll 4
      for (int64_t i = 0; i < count; ++i) sum = plus(sum, row(range.x, i, q));
    }
    for (unsigned left = large; left != 0; left &= left - 1) {
      const int owner = __ffs(int(left)) - 1;
      const uint32_t first = __shfl_sync(kAll, range.x, owner);
      const int64_t many = __shfl_sync(kAll, count, owner);
      float4 part = make_float4(0, 0, 0, 0);
      if (q < quads) {
#pragma unroll 4
        for (int64_t i = lane / 4; i < many; i += 8) part = plus(part, row(first, i, q));
      }
      for (int mask = 4; mask < 32; mask *= 2) part = plus(part, from_lane_xor(part, mask));
      if (lane / 4 == owner / 4) sum = part;
    }
    if (splat >= in.count || q >= quads) continue;
    const float values[4] = {sum.x, sum.y, sum.z, sum.w};
    if (q == 0) {
      const float a = usable ? in.conics[3 * splat] : 0, b = usable ? in.conics[3 * splat + 1] : 0;
      const float c = usable ? in.conics[3 * splat + 2] : 0;
      out.means2d[2 * splat] = a * sum.y + b * sum.z;
      out.means2d[2 * splat + 1] = b * sum.y + c * sum.z;
      out.conics[3 * splat] = -0.5f * sum.w;
      out.opacities[splat] = usable ? sum.x / in.opacities[splat] : 0;
    } else if (q == 1) {
      out.conics[3 * splat + 1] = -sum.x;
      out.conics[3 * splat + 2] = -0.5f * sum.y;
    }
    for (int r = 0; r < 4; ++r) {
      const int at = 4 * q + r;
      if (at >= shape && at < shape + in.channels) out.colors[splat * in.channels + at - shape] = values[r];
      if (out.absolute != nullptr && at >= kShapeMoments && at < kShapeMoments + 2)
        out.absolute[2 * splat + at - kShapeMoments] = values[r];
    }
  }
}

// Positions of the instances sorted by splat, and the range of each splat.
struct Instances {
  const uint32_t* positions;
  const uint2* ranges;
};
Instances by_splat(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  uint2* const ranges = scratch.array<uint2>(in.count);
  check_cuda(cudaMemsetAsync(ranges, 0, size_t(in.count) * sizeof(uint2), stream), "clearing instance ranges");
  if (in.instances == 0) return {nullptr, ranges};
  const auto array = [&] { return scratch.array<uint32_t>(in.instances); };
  cub::DoubleBuffer<uint32_t> splats(array(), array()), positions(array(), array());
  number_instances<<<blocks_for(in.instances), kThreads, 0, stream>>>(in, splats.Current(), positions.Current());
  const int bits = bits_below(in.count + 1);
  size_t size = 0;
  check_cuda(cub::DeviceRadixSort::SortPairs(nullptr, size, splats, positions, in.instances, 0, bits, stream),
             "sorting instances by splat");
  check_cuda(cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, splats, positions, in.instances, 0, bits, stream),
             "sorting instances by splat");
  ranges_of_splats<<<blocks_for(in.instances), kThreads, 0, stream>>>(in, splats.Current(), ranges);
  return {positions.Current(), ranges};
}

}  // namespace

}  // namespace gsplat::compositing
