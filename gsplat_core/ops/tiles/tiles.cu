#include "cub_device.cuh"
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "tile_ellipse.cuh"

namespace gsplat::tiles {
namespace {

__device__ int64_t image_of(const SplatBoxes& in, int64_t splat) {
  return in.image_ids != nullptr ? in.image_ids[splat] : splat / in.per_image;
}

// Sizes from which a splat has many tiles. A thread counts or writes the tiles of its splat. For a splat with many
// tiles the whole warp does so, because the other lanes would otherwise wait.
constexpr int kTallRows = 16, kManyTiles = 32;

__device__ int tiles_of(const SplatBoxes& in, const TileBox& box) {
  int tiles = 0;
  for_tile_rows(box, float(in.tile_size), [&](int, int first, int end) { tiles += end - first; });
  return tiles;
}

// Compute tile counts and the keys of the depth sort. Depths are sorted by their bits, so positive depths precede
// negative ones, as in gsplat.
__global__ void measure_splats(SplatBoxes in, int32_t* tile_counts, uint32_t* keys, uint32_t* splats) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % 32;
  const TileBox box = i < in.count ? tile_box(in, i) : TileBox{};
  const bool tall = box.bottom - box.top >= kTallRows;
  int tiles = tall ? 0 : tiles_of(in, box);
  for (unsigned left = __ballot_sync(~0u, tall); left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    const TileBox whole = tile_box(in, i - lane + owner);
    int part = 0;
    for (int row = whole.top + lane; row < whole.bottom; row += 32) {
      TileBox one = whole;
      one.top = row, one.bottom = row + 1;
      part += tiles_of(in, one);
    }
    part = __reduce_add_sync(~0u, part);
    if (lane == owner) tiles = part;
  }
  if (i >= in.count) return;
  tile_counts[i] = tiles;
  if (keys == nullptr) return;
  keys[i] = tiles > 0 ? __float_as_uint(in.depths[i]) : ~0u;
  splats[i] = uint32_t(i);
}

__global__ void counts_in_order(int64_t count, const uint32_t* splats, const int32_t* tile_counts, int64_t* counts) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i <= count) counts[i] = i == count ? 0 : tile_counts[splats != nullptr ? splats[i] : i];
}

// Write the tiles of one splat from `at` on. A lane writes every `step`th tile of a row, starting with its own index.
__device__ void emit_splat(const SplatBoxes& in, int64_t splat, int64_t at, int lane, int step, const TileInstances& to) {
  const uint32_t first_tile = uint32_t(image_of(in, splat) * in.tile_width * in.tile_height) + to.capacity;
  for_tile_rows(tile_box(in, splat), float(in.tile_size), [&](int row, int first, int end) {
    for (int column = first + lane; column < end; column += step) {
      to.tiles[0][at + column - first] = first_tile + uint32_t(row * in.tile_width + column);
      to.splats[0][at + column - first] = int32_t(splat);
    }
    at += end - first;
  });
}

__global__ void emit(SplatBoxes in, TileOrder order, TileInstances to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int lane = threadIdx.x % 32;
  int64_t splat = 0, at = 0, count = 0;
  if (i < in.count) {
    splat = order.splats != nullptr ? order.splats[i] : i;
    at = order.starts[i];
    const int64_t end = order.starts[i + 1];
    count = end <= to.count ? end - at : 0;
  }
  if (count > 0 && count < kManyTiles) emit_splat(in, splat, at, 0, 1, to);
  for (unsigned left = __ballot_sync(~0u, count >= kManyTiles); left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    emit_splat(in, __shfl_sync(~0u, splat, owner), __shfl_sync(~0u, at, owner), lane, 32, to);
  }
}

// Return the number of the `count` sorted values key(0), key(1), ... below `value`.
template <class Key>
__device__ int64_t count_below(int64_t count, int64_t value, const Key& key) {
  int64_t low = 0, high = count;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (key(middle) < value) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

__global__ void offsets_of_tiles(const uint32_t* sorted, int64_t count, int64_t first, int64_t tiles, int32_t* offsets) {
  const int64_t tile = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (tile < tiles) offsets[tile] = int32_t(count_below(count, first + tile, [&](int64_t i) { return int64_t(sorted[i]); }));
}

__global__ void offsets_of_ids(const int64_t* ids, int64_t count, int64_t images, int64_t tiles, int tile_bits,
                               int32_t* offsets) {
  const int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (at >= images * tiles) return;
  const int64_t key = (at / tiles) << tile_bits | at % tiles;
  offsets[at] = int32_t(count_below(count, key, [&](int64_t i) { return ids[i] >> 32; }));
}

// Number of bits for n values, as gsplat counts them: floor(log2(n)) + 1.
int gsplat_bits(int64_t n) { return n > 0 ? 64 - __builtin_clzll(uint64_t(n)) : 1; }

__global__ void ids_of_instances(SplatBoxes in, const uint32_t* tiles, const int32_t* splats, int64_t count, int tile_bits,
                                 int64_t* ids) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  const int64_t per_image = int64_t(in.tile_width) * in.tile_height, image = tiles[i] / per_image, tile = tiles[i] % per_image;
  ids[i] = image << (32 + tile_bits) | tile << 32 | int64_t(__float_as_uint(in.depths[splats[i]]));
}

}  // namespace

TileOrder order_splats(const SplatBoxes& in, bool by_depth, int32_t* tile_counts, CudaScratch& scratch, cudaStream_t stream) {
  TileOrder order = {nullptr, scratch.array<int64_t>(in.count + 1)};
  if (by_depth) {
    cub::DoubleBuffer<uint32_t> keys(scratch.array<uint32_t>(in.count), scratch.array<uint32_t>(in.count));
    cub::DoubleBuffer<uint32_t> splats(scratch.array<uint32_t>(in.count), scratch.array<uint32_t>(in.count));
    measure_splats<<<blocks_for(in.count), kThreads, 0, stream>>>(in, tile_counts, keys.Current(), splats.Current());
    size_t size = 0;
    check_cuda(cub::DeviceRadixSort::SortPairs(nullptr, size, keys, splats, in.count, 0, 32, stream), "sorting on the GPU");
    check_cuda(cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, keys, splats, in.count, 0, 32, stream),
               "sorting on the GPU");
    order.splats = splats.Current();
  } else {
    measure_splats<<<blocks_for(in.count), kThreads, 0, stream>>>(in, tile_counts, nullptr, nullptr);
  }
  counts_in_order<<<blocks_for(in.count + 1), kThreads, 0, stream>>>(in.count, order.splats, tile_counts, order.starts);
  size_t size = 0;
  check_cuda(cub::DeviceScan::ExclusiveSum(nullptr, size, order.starts, order.starts, in.count + 1, stream),
             "summing on the GPU");
  check_cuda(cub::DeviceScan::ExclusiveSum(scratch.bytes(size), size, order.starts, order.starts, in.count + 1, stream),
             "summing on the GPU");
  return order;
}

void emit_instances(const SplatBoxes& in, const TileOrder& order, TileInstances& instances, cudaStream_t stream) {
  instances.current = 0;
  if (instances.count == 0) return;
  if (instances.capacity) {
    check_cuda(cudaMemsetAsync(instances.tiles[0], 0, size_t(instances.count) * sizeof(uint32_t), stream),
               "clearing the tile list");
    check_cuda(cudaMemsetAsync(instances.splats[0], 0xff, size_t(instances.count) * sizeof(int32_t), stream),
               "clearing the tile list");
  }
  if (in.count > 0) emit<<<blocks_for(in.count), kThreads, 0, stream>>>(in, order, instances);
}

void sort_by_tile(const SplatBoxes& in, TileInstances& instances, CudaScratch& scratch, cudaStream_t stream) {
  if (instances.count == 0) return;
  cub::DoubleBuffer<uint32_t> tiles(instances.tiles[0], instances.tiles[1]);
  cub::DoubleBuffer<int32_t> splats(instances.splats[0], instances.splats[1]);
  const int bits = bits_below(int64_t(in.images) * in.tile_width * in.tile_height + instances.capacity);
  size_t size = 0;
  check_cuda(cub::DeviceRadixSort::SortPairs(nullptr, size, tiles, splats, instances.count, 0, bits, stream),
             "sorting on the GPU");
  check_cuda(cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, tiles, splats, instances.count, 0, bits, stream),
             "sorting on the GPU");
  instances.current = tiles.selector;
}

void encode_offsets(const TileInstances& instances, int64_t tiles, int32_t* offsets, cudaStream_t stream) {
  if (tiles == 0) return;
  offsets_of_tiles<<<blocks_for(tiles), kThreads, 0, stream>>>(instances.tiles[instances.current], instances.count,
                                                               instances.capacity, tiles, offsets);
}

void encode_offsets(const int64_t* ids, int64_t count, int64_t images, int64_t tiles_per_image, int32_t* offsets,
                    cudaStream_t stream) {
  if (images * tiles_per_image == 0) return;
  offsets_of_ids<<<blocks_for(images * tiles_per_image), kThreads, 0, stream>>>(ids, count, images, tiles_per_image,
                                                                                gsplat_bits(tiles_per_image), offsets);
}

void make_ids(const SplatBoxes& in, const TileInstances& instances, int64_t* ids, cudaStream_t stream) {
  if (instances.count == 0) return;
  ids_of_instances<<<blocks_for(instances.count), kThreads, 0, stream>>>(
      in, instances.tiles[instances.current], instances.splats[instances.current], instances.count,
      gsplat_bits(int64_t(in.tile_width) * in.tile_height), ids);
}

}  // namespace gsplat::tiles
