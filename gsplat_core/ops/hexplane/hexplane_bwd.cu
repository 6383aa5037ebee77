// Gradients of one level's features. A row of gradient per plane and point, then every node of a plane adds the rows around it,
// in the order of the points within each cell: no atomic additions, and the same bits every time.

#include "cub_device.cuh"
#include "hexplane_cuda.h"
#include "node_gradient.cuh"
#include "team_launch.h"

using namespace hexplane;

namespace {

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads)
    sample_gradients(HexPlanes level, const float* __restrict__ gradient, const int32_t* __restrict__ ranks, float* rows,
                     float* shares, float* v_coordinates, int64_t count) {
  const int64_t index = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  const int64_t n = index < count ? index : count - 1;  // the last team's lanes take part in the sums
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
    *reinterpret_cast<float2*>(shares + 2 * int64_t(ranks[p * count + n])) = make_float2(at.v.fraction, at.u.fraction);
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
  atomicAdd(counts + key, 1);  // whole numbers: their sum does not depend on the order
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

}  // namespace

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
  float *rows = scratch.array<float>(items * channels), *shares = scratch.array<float>(2 * items);
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
          <<<blocks_for(count * team()), kThreads, 0, stream>>>(level, gradient, ranks, rows, shares, v_coordinates, count);
    });
  }
  for (int p = 0; p < kPlanes; ++p) {
    const FeaturePlane& plane = level.planes[p];
    const SortedCells plane_cells = {starts + cells.first[p], rows, shares, nullptr, plane.width};
    const int64_t values = int64_t(plane.width) * plane.height * channels;
    if (bits % 16 == 0) {
      add_rows<4><<<blocks_for(values / 4), kThreads, 0, stream>>>(plane_cells, v_planes[p], plane.height, int(channels));
    } else {
      add_rows<1><<<blocks_for(values), kThreads, 0, stream>>>(plane_cells, v_planes[p], plane.height, int(channels));
    }
  }
}
