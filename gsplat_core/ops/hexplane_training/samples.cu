// Sorts Gaussians by cell, and computes their features and the gradient rows of their samples.
#include "../hexplane/plane_samples.cuh"
#include "cub_device.cuh"
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "training.h"

namespace gsplat::hexplane {
namespace {

__global__ void __launch_bounds__(kThreads)
    coordinates_of(const float* __restrict__ means, const float* __restrict__ box, float* coordinates, int64_t count) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (n >= count) return;
  float x[3];
  bool finite = true;
  for (int axis = 0; axis < 3; ++axis) {
    const float mean = means[3 * n + axis], low = box[axis], high = box[3 + axis];
    finite &= isfinite(mean);
    x[axis] = fminf(fmaxf(2.0f * (mean - low) / (high - low) - 1.0f, -1.0f), 1.0f);
    finite &= isfinite(x[axis]);
  }
  const float4 placed = finite ? make_float4(x[0], x[1], x[2], 1.0f) : make_float4(0.0f, 0.0f, 0.0f, 0.0f);
  *reinterpret_cast<float4*>(coordinates + 4 * n) = placed;
}

// Count the items of each cell, with one thread per item. Counts are integers, so their atomic sums do not depend on
// the order.
__global__ void __launch_bounds__(kThreads)
    cells_of(FieldPlanes planes, FieldCells cells, uint32_t* keys, int32_t* items, int32_t* counts) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (n >= cells.count) return;
  const int slot = int(blockIdx.y), level = slot / 3, p = slot % 3;
  const int64_t item = slot * cells.count + n;
  const float* x = cells.coordinates + 4 * n;
  int64_t key = cells.cells;
  if (x[3] != 0.0f) {
    const int major = major_axis(p), minor = minor_axis(p);
    const int32_t minor_size = planes.sizes[level][minor];
    key = cells.first[level][p] + position_on(x[major], planes.sizes[level][major]).cell * minor_size +
          position_on(x[minor], minor_size).cell;
    atomicAdd(counts + key, 1);
  }
  keys[item] = uint32_t(key);
  items[item] = int32_t(item);
}

__global__ void __launch_bounds__(kThreads) rank_items(FieldCells cells, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  cells.ranks[cells.items[i]] = int32_t(i);
  const uint32_t cell = cells.keys[i];
  if (cell < cells.cells && cells.starts[cell + 1] - cells.starts[cell] >= kDenseCell) cells.keys[i] = cell | kDenseBit;
}

// Compute features from samples. A team of lanes processes one Gaussian at one level.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads, 3)
    features_kernel(FieldPlanes planes, FieldLines lines, FieldCells cells, float* __restrict__ features) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= cells.count) return;
  const int level = int(blockIdx.y), channels = planes.channels;
  const float4 at4 = *reinterpret_cast<const float4*>(cells.coordinates + 4 * n);
  const int32_t* sizes = planes.sizes[level];
  const LinePosition places[3] = {position_on(at4.x, sizes[0]), position_on(at4.y, sizes[1]), position_on(at4.z, sizes[2])};
  float* out = features + (n * planes.levels + level) * channels;
  const float* values = static_cast<const float*>(lines.values);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::all(at4.w);
#pragma unroll
    for (int p = 0; p < 3; ++p) {
      const FeaturePlane plane = planes.plane(level, p);
      const Corners at(plane, places[u_axis(p)], places[v_axis(p)], channels);
      value = value * Sample<kLane>(plane.values, at, c).value(at);
    }
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      const float* left = values + lines.starts[level][axis] + int32_t(places[axis].cell) * channels + c;
      const float* right = left + (planes.sizes[level][axis] > 1 ? channels : 0);
      value = value * between(Channels<kLane>::load(left), Channels<kLane>::load(right), places[axis].fraction);
    }
    value.store(out + c);
  }
}

// A team of lanes processes one Gaussian at all levels, so that the gradient of its position is one sum. Teams take
// Gaussians in the cell order of the first plane, in which neighbours read the same nodes.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads, 2)
    rows_kernel(FieldPlanes planes, FieldLines lines, FieldCells cells, const float* __restrict__ box,
                const float* __restrict__ v_features, FieldRows rows, float* v_raw) {
  const int64_t index = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  const int64_t item = index < cells.count ? cells.items[index] : cells.count;  // items of the next plane follow
  const bool inside = item < cells.count;
  const int64_t n = inside ? item : 0;  // lanes without a Gaussian take part in the warp's sums
  const int lane = int(threadIdx.x) % kTeam, channels = planes.channels;
  const float4 at4 = *reinterpret_cast<const float4*>(cells.coordinates + 4 * n);
  const bool active = inside && at4.w != 0.0f;
  const float* values = static_cast<const float*>(lines.values);
  float v_x[3] = {};
  for (int level = 0; level < planes.levels && active; ++level) {
    int32_t ranks[3];
#pragma unroll
    for (int p = 0; p < 3; ++p) ranks[p] = cells.ranks[(3 * level + p) * cells.count + n];
    const int32_t* sizes = planes.sizes[level];
    const LinePosition places[3] = {position_on(at4.x, sizes[0]), position_on(at4.y, sizes[1]), position_on(at4.z, sizes[2])};
    float v_place[3] = {};  // gradient of the position, in units of cells
    for (int c = lane * kLane; c < channels; c += kTeam * kLane) {
      const auto v = Channels<kLane>::load(v_features + (n * planes.levels + level) * channels + c);
      Channels<kLane> value[6], along_u[6], along_v[3];
#pragma unroll
      for (int p = 0; p < 3; ++p) {
        const FeaturePlane plane = planes.plane(level, p);
        const Corners at(plane, places[u_axis(p)], places[v_axis(p)], channels);
        Sample<kLane>(plane.values, at, c).value_and_slopes(at, value[p], along_u[p], along_v[p]);
      }
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
        const float* left = values + lines.starts[level][axis] + int32_t(places[axis].cell) * channels + c;
        const auto a = Channels<kLane>::load(left), b = Channels<kLane>::load(left + (sizes[axis] > 1 ? channels : 0));
        along_u[3 + axis] = b - a;
        value[3 + axis] = plus(a, places[axis].fraction, along_u[3 + axis]);
      }
      Channels<kLane> before[6], after = Channels<kLane>::all(1.0f);
      before[0] = v;
#pragma unroll
      for (int p = 1; p < 6; ++p) before[p] = before[p - 1] * value[p - 1];
#pragma unroll
      for (int p = 5; p >= 0; --p) {
        const Channels<kLane> g = before[p] * after;
        after = after * value[p];
        g.store((p < 3 ? rows.space : rows.lines) + int64_t(ranks[p < 3 ? p : plane_of_major(p - 3)]) * channels + c);
        if (p < 3) {
          v_place[u_axis(p)] += (g * along_u[p]).sum();
          v_place[v_axis(p)] += (g * along_v[p]).sum();
        } else {
          v_place[p - 3] += (g * along_u[p]).sum();
        }
      }
    }
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) v_x[axis] += v_place[axis] * places[axis].slope;
    // The fractions are stored after the level's loads: the compiler cannot move a load to before a store.
#pragma unroll
    for (int p = 0; p < 3; ++p) {
      if (lane != p) continue;
      *reinterpret_cast<float2*>(rows.fractions + 2 * int64_t(ranks[p])) =
          make_float2(places[major_axis(p)].fraction, places[minor_axis(p)].fraction);
    }
  }
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    const float sum = team_sum<kTeam>(v_x[axis]);
    if (lane == axis && active) v_raw[n * kRawColumns + kRawPosition + axis] += sum * 2.0f / (box[3 + axis] - box[axis]);
  }
}

bool wide(const FieldPlanes& planes, const FieldLines& lines) {
  uintptr_t bits = uintptr_t(planes.channels) * 4 | uintptr_t(lines.values);
  for (int l = 0; l < planes.levels; ++l)
    for (const float* plane : planes.space[l]) bits |= uintptr_t(plane);
  return bits % 16 == 0;
}

}  // namespace

void place_gaussians(const float* means, const float* box, const FieldCells& cells, cudaStream_t stream) {
  if (cells.count > 0)
    coordinates_of<<<blocks_for(cells.count), kThreads, 0, stream>>>(means, box, cells.coordinates, cells.count);
}

void sort_gaussians(const FieldPlanes& planes, const FieldCells& cells, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t slots = 3 * planes.levels, count = slots * cells.count;
  if (count == 0) {
    check_cuda(cudaMemsetAsync(cells.starts, 0, size_t(cells.cells + 1) * sizeof(int32_t), stream), "clearing cell starts");
    return;
  }
  uint32_t* keys = scratch.array<uint32_t>(count);
  int32_t *items = scratch.array<int32_t>(count), *counts = scratch.array<int32_t>(cells.cells + 1);
  check_cuda(cudaMemsetAsync(counts, 0, size_t(cells.cells + 1) * sizeof(int32_t), stream), "clearing cell counts");
  cells_of<<<dim3(blocks_for(cells.count), unsigned(slots)), kThreads, 0, stream>>>(planes, cells, keys, items, counts);
  size_t size = 0;
  check_cuda(cub::DeviceScan::ExclusiveSum(nullptr, size, counts, cells.starts, cells.cells + 1, stream), "summing cell counts");
  check_cuda(cub::DeviceScan::ExclusiveSum(scratch.bytes(size), size, counts, cells.starts, cells.cells + 1, stream),
             "summing cell counts");
  const int bits = bits_below(cells.cells + 1);
  check_cuda(cub::DeviceRadixSort::SortPairs(nullptr, size, keys, cells.keys, items, cells.items, count, 0, bits, stream),
             "sorting Gaussians by cell");
  check_cuda(
      cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, keys, cells.keys, items, cells.items, count, 0, bits, stream),
      "sorting Gaussians by cell");
  rank_items<<<blocks_for(count), kThreads, 0, stream>>>(cells, count);
}

void field_features(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, float* features,
                    cudaStream_t stream) {
  if (cells.count == 0) return;
  with_team(wide(planes, lines), planes.channels, [&](auto lane, auto team) {
    const dim3 grid(blocks_for(cells.count * team()), unsigned(planes.levels));
    features_kernel<lane(), team()><<<grid, kThreads, 0, stream>>>(planes, lines, cells, features);
  });
}

void field_rows(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const float* box,
                const float* v_features, const FieldRows& rows, float* v_raw, cudaStream_t stream) {
  if (cells.count == 0) return;
  with_team(wide(planes, lines), planes.channels, [&](auto lane, auto team) {
    rows_kernel<lane(), team()>
        <<<blocks_for(cells.count * team()), kThreads, 0, stream>>>(planes, lines, cells, box, v_features, rows, v_raw);
  });
}

}  // namespace gsplat::hexplane
