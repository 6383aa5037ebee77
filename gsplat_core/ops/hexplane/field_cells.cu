
#include "cub_device.cuh"
#include "line_position.h"
#include "node_gradient.cuh"
#include "training_cuda.h"

using namespace GSPLAT_ISA;

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

// One thread per item; counts are of whole numbers, so their sums do not depend on the order.
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
  if (cell < cells.cells && cells.starts[cell + 1] - cells.starts[cell] >= hexplane::kCrowded) cells.keys[i] = cell | kCrowdedBit;
}

}  // namespace

void place_gaussians(const float* means, const float* box, const FieldCells& cells, cudaStream_t stream) {
  if (cells.count > 0)
    coordinates_of<<<blocks_for(cells.count), kThreads, 0, stream>>>(means, box, cells.coordinates, cells.count);
}

void sort_gaussians(const FieldPlanes& planes, const FieldCells& cells, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t slots = 3 * planes.levels, count = slots * cells.count;
  if (count == 0) {
    cudaMemsetAsync(cells.starts, 0, size_t(cells.cells + 1) * sizeof(int32_t), stream);
    return;
  }
  uint32_t* keys = scratch.array<uint32_t>(count);
  int32_t *items = scratch.array<int32_t>(count), *counts = scratch.array<int32_t>(cells.cells + 1);
  cudaMemsetAsync(counts, 0, size_t(cells.cells + 1) * sizeof(int32_t), stream);
  cells_of<<<dim3(blocks_for(cells.count), unsigned(slots)), kThreads, 0, stream>>>(planes, cells, keys, items, counts);
  size_t size = 0;
  cub::DeviceScan::ExclusiveSum(nullptr, size, counts, cells.starts, cells.cells + 1, stream);
  cub::DeviceScan::ExclusiveSum(scratch.bytes(size), size, counts, cells.starts, cells.cells + 1, stream);
  const int bits = bits_below(cells.cells + 1);
  cub::DeviceRadixSort::SortPairs(nullptr, size, keys, cells.keys, items, cells.items, count, 0, bits, stream);
  cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, keys, cells.keys, items, cells.items, count, 0, bits, stream);
  rank_items<<<blocks_for(count), kThreads, 0, stream>>>(cells, count);
}
