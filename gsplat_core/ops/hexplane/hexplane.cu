// Features of one level and their gradients. The backward pass writes one gradient row per plane and point. Every node
// of a plane then adds the surrounding rows, in the order of the points within each cell. There are no atomic float
// additions, so results are bitwise reproducible.
#include "cub_device.cuh"
#include "cuda_scratch.h"
#include "plane_samples.cuh"

namespace gsplat::hexplane {
namespace {

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) product(HexPlanes level, int first, int last, float* features, int64_t count) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= count) return;
  const float* x = level.coordinates + 4 * n;
  const int channels = int(level.channels);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::all(1.0f);
#pragma unroll
    for (int p = 0; p < kPlanes; ++p) {
      if (p < first || p >= last) continue;
      const Corners at(level.planes[p], x[u_axis(p)], x[v_axis(p)], channels);
      value = value * Sample<kLane>(level.planes[p].values, at, c).value(at);
    }
    value.store(features + n * channels + c);
  }
}

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) modulate(HexPlanes level, const float* space, float* features, int64_t count) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= count) return;
  const int channels = int(level.channels);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::load(space + n * channels + c);
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      const FeaturePlane& line = level.planes[axis];
      const LinePosition at = position_on(level.coordinates[4 * n + axis], line.width);
      const float* left = line.values + at.cell * channels + c;
      const float* right = left + (line.width > 1 ? channels : 0);
      value = value * between(Channels<kLane>::load(left), Channels<kLane>::load(right), at.fraction);
    }
    value.store(features + n * channels + c);
  }
}

// Return true if every row of channels is aligned to 16 bytes.
bool wide(const HexPlanes& level, int planes, const void* a, const void* b) {
  uintptr_t bits = uintptr_t(level.channels) * 4 | uintptr_t(a) | uintptr_t(b);
  for (int p = 0; p < planes; ++p) bits |= uintptr_t(level.planes[p].values);
  return bits % 16 == 0;
}

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads)
    sample_gradients(HexPlanes level, const float* __restrict__ gradient, const int32_t* __restrict__ ranks, float* rows,
                     float* fractions, float* v_coordinates, int64_t count) {
  const int64_t index = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  const int64_t n = index < count ? index : count - 1;  // lanes past the end take part in the warp's sums
  const int lane = int(threadIdx.x) % kTeam, channels = int(level.channels);
  float x[4], v_x[4] = {};
  for (int axis = 0; axis < 4; ++axis) x[axis] = level.coordinates[4 * n + axis];
  for (int c = lane * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value[kPlanes], before[kPlanes + 1], after = Channels<kLane>::all(1.0f);
    before[0] = Channels<kLane>::load(gradient + n * channels + c);
#pragma unroll
    for (int p = 0; p < kPlanes; ++p) {
      const Corners at(level.planes[p], x[u_axis(p)], x[v_axis(p)], channels);
      value[p] = Sample<kLane>(level.planes[p].values, at, c).value(at);
      before[p + 1] = before[p] * value[p];
    }
#pragma unroll
    for (int p = kPlanes - 1; p >= 0; --p) {
      const Channels<kLane> g = before[p] * after;
      after = after * value[p];
      if (index < count) g.store(rows + int64_t(ranks[p * count + n]) * channels + c);
      const Corners at(level.planes[p], x[u_axis(p)], x[v_axis(p)], channels);
      const Sample<kLane> sample(level.planes[p].values, at, c);
      v_x[u_axis(p)] += (g * sample.along_u(at)).sum() * at.u.slope;
      v_x[v_axis(p)] += (g * sample.along_v(at)).sum() * at.v.slope;
    }
  }
#pragma unroll
  for (int p = 0; p < kPlanes; ++p) {
    if (lane != p || index >= count) continue;
    const Corners at(level.planes[p], x[u_axis(p)], x[v_axis(p)], channels);
    *reinterpret_cast<float2*>(fractions + 2 * int64_t(ranks[p * count + n])) = make_float2(at.v.fraction, at.u.fraction);
  }
#pragma unroll
  for (int axis = 0; axis < 4; ++axis) {
    const float sum = team_sum<kTeam>(v_x[axis]);
    if (lane == axis && index < count) v_coordinates[4 * n + axis] = sum;
  }
}

struct PlaneCells {
  int64_t first[kPlanes + 1];
};

__global__ void __launch_bounds__(kThreads)
    cells_of(HexPlanes level, PlaneCells cells, uint32_t* keys, int32_t* items, int32_t* counts, int64_t count) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (n >= count) return;
  const int p = int(blockIdx.y);
  const FeaturePlane& plane = level.planes[p];
  const float* x = level.coordinates + 4 * n;
  const int64_t key =
      cells.first[p] + position_on(x[v_axis(p)], plane.height).cell * plane.width + position_on(x[u_axis(p)], plane.width).cell;
  atomicAdd(counts + key, 1);  // integer sums do not depend on the order
  keys[p * count + n] = uint32_t(key);
  items[p * count + n] = int32_t(p * count + n);
}

__global__ void __launch_bounds__(kThreads) rank_items(const int32_t* __restrict__ items, int32_t* ranks, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) ranks[items[i]] = int32_t(i);
}

template <int kLane>
__global__ void __launch_bounds__(kThreads) add_rows(SortedCells cells, float* gradient, int major_size, int channels) {
  const int64_t i = (int64_t(blockIdx.x) * kThreads + threadIdx.x) * kLane, node = i / channels;
  if (node >= int64_t(major_size) * cells.minor_size) return;
  node_gradient<kLane>(cells, int(node / cells.minor_size), int(node % cells.minor_size), int(i % channels), channels)
      .store(gradient + i);
}

// Dense float32 layer of any size: tiles of 64 rows and 64 outputs in shared memory, 4 x 4 of them per thread.
constexpr int kTile = 64, kDeep = 16;

__global__ void __launch_bounds__(kThreads)
    linear(const float* __restrict__ in, int64_t in_stride, const float* __restrict__ weight, const float* __restrict__ bias,
           float* __restrict__ out, int64_t out_stride, int64_t count, int inputs, int outputs, bool rectify) {
  __shared__ float rows[kDeep][kTile + 4], columns[kDeep][kTile + 4];
  const int64_t first_row = int64_t(blockIdx.x) * kTile;
  const int first_output = int(blockIdx.y) * kTile, r = int(threadIdx.x) / 16 * 4, o = int(threadIdx.x) % 16 * 4;
  float sums[4][4] = {};
  for (int k0 = 0; k0 < inputs; k0 += kDeep) {
    for (int i = int(threadIdx.x); i < kTile * kDeep; i += kThreads) {
      const int k = i % kDeep, at = i / kDeep;
      const bool inside = k0 + k < inputs;
      rows[k][at] = inside && first_row + at < count ? in[(first_row + at) * in_stride + k0 + k] : 0.0f;
      columns[k][at] = inside && first_output + at < outputs ? weight[int64_t(first_output + at) * inputs + k0 + k] : 0.0f;
    }
    __syncthreads();
#pragma unroll
    for (int k = 0; k < kDeep; ++k)
#pragma unroll
      for (int i = 0; i < 4; ++i)
#pragma unroll
        for (int j = 0; j < 4; ++j) sums[i][j] += rows[k][r + i] * columns[k][o + j];
    __syncthreads();
  }
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) {
      if (first_row + r + i >= count || first_output + o + j >= outputs) continue;
      const float x = sums[i][j] + bias[first_output + o + j];
      out[(first_row + r + i) * out_stride + first_output + o + j] = rectify && x < 0.0f ? 0.0f : x;  // NaN propagates
    }
}

}  // namespace

void plane_product(const HexPlanes& level, int first, int last, float* features, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  with_team(wide(level, last, features, nullptr), level.channels, [&](auto lane, auto team) {
    product<lane(), team()><<<blocks_for(count * team()), kThreads, 0, stream>>>(level, first, last, features, count);
  });
}

void modulate_lines(const HexPlanes& level, const float* space, float* features, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  with_team(wide(level, 3, space, features), level.channels, [&](auto lane, auto team) {
    modulate<lane(), team()><<<blocks_for(count * team()), kThreads, 0, stream>>>(level, space, features, count);
  });
}

void plane_gradients(const HexPlanes& level, const float* gradient, float* v_coordinates, float* const* v_planes, int64_t count,
                     CudaScratch& scratch, cudaStream_t stream) {
  const int64_t channels = level.channels, items = kPlanes * count;
  PlaneCells cells = {};
  uintptr_t bits = uintptr_t(channels) * 4 | uintptr_t(gradient);
  for (int p = 0; p < kPlanes; ++p) {
    const FeaturePlane& plane = level.planes[p];
    cells.first[p + 1] = cells.first[p] + int64_t(plane.width) * plane.height;
    bits |= uintptr_t(plane.values) | uintptr_t(v_planes[p]);
  }
  const int64_t all = cells.first[kPlanes];
  float *rows = scratch.array<float>(items * channels), *fractions = scratch.array<float>(2 * items);
  uint32_t *keys = scratch.array<uint32_t>(items), *sorted_keys = scratch.array<uint32_t>(items);
  int32_t *unsorted = scratch.array<int32_t>(items), *sorted = scratch.array<int32_t>(items);
  int32_t *counts = scratch.array<int32_t>(all + 1), *starts = scratch.array<int32_t>(all + 1);
  cudaMemsetAsync(counts, 0, size_t(all + 1) * sizeof(int32_t), stream);
  if (count > 0) cells_of<<<dim3(blocks_for(count), kPlanes), kThreads, 0, stream>>>(level, cells, keys, unsorted, counts, count);
  size_t size = 0;
  cub::DeviceScan::ExclusiveSum(nullptr, size, counts, starts, all + 1, stream);
  cub::DeviceScan::ExclusiveSum(scratch.bytes(size), size, counts, starts, all + 1, stream);
  cub::DeviceRadixSort::SortPairs(nullptr, size, keys, sorted_keys, unsorted, sorted, items, 0, bits_below(all), stream);
  cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, keys, sorted_keys, unsorted, sorted, items, 0, bits_below(all),
                                  stream);
  if (count > 0) {
    int32_t* ranks = scratch.array<int32_t>(items);
    rank_items<<<blocks_for(items), kThreads, 0, stream>>>(sorted, ranks, items);
    with_team(bits % 16 == 0, channels, [&](auto lane, auto team) {
      sample_gradients<lane(), team()>
          <<<blocks_for(count * team()), kThreads, 0, stream>>>(level, gradient, ranks, rows, fractions, v_coordinates, count);
    });
  }
  for (int p = 0; p < kPlanes; ++p) {
    const FeaturePlane& plane = level.planes[p];
    const SortedCells plane_cells = {starts + cells.first[p], rows, fractions, nullptr, plane.width};
    const int64_t values = int64_t(plane.width) * plane.height * channels;
    if (bits % 16 == 0) {
      add_rows<4><<<blocks_for(values / 4), kThreads, 0, stream>>>(plane_cells, v_planes[p], plane.height, int(channels));
    } else {
      add_rows<1><<<blocks_for(values), kThreads, 0, stream>>>(plane_cells, v_planes[p], plane.height, int(channels));
    }
  }
}

void linear_layer(const float* in, int64_t in_stride, const float* weight, const float* bias, float* out, int64_t out_stride,
                  int64_t count, int inputs, int outputs, bool rectify, cudaStream_t stream) {
  if (count == 0 || outputs == 0) return;
  const dim3 grid(blocks_for(count, kTile), blocks_for(outputs, kTile));
  linear<<<grid, kThreads, 0, stream>>>(in, in_stride, weight, bias, out, out_stride, count, inputs, outputs, rectify);
}

}  // namespace gsplat::hexplane
