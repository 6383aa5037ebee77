// Conversion of splats to instances: the tiles that a splat touches, their number, and the keys of its instances.
#pragma once

#include "../blending/splats.cuh"
#include "../tiles/tile_ellipse.cuh"
#include "frame.h"

namespace gsplat::frame {
namespace {

using namespace blending;

using namespace gsplat::tiles;

constexpr uint32_t kMaxSum = 0x7fffffffu;  // sums saturate at this value; min(a + b, kMaxSum) is associative

__device__ inline uint32_t saturating_add(uint32_t a, uint32_t b) { return min(a + b, kMaxSum); }

// Sum over the preceding threads, and over the whole block.
struct BlockSum {
  uint32_t before, all;
};
__device__ inline uint32_t inclusive_warp_sum(uint32_t value) {
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAll, value, step);
    if ((threadIdx.x & 31) >= step) value = saturating_add(value, before);
  }
  return value;
}
// Return the prefix sum of `value` over the threads of a block. `warp_sums` is shared memory for 32 values; it may be
// reused after the next barrier.
__device__ inline BlockSum sum_over_block(uint32_t value, uint32_t* warp_sums) {
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, warps = int(blockDim.x) / 32;
  const uint32_t through = inclusive_warp_sum(value), before = __shfl_up_sync(kAll, through, 1);
  if (lane == 31) warp_sums[warp] = through;
  __syncthreads();
  // Every warp adds up the warps' sums redundantly, which saves a barrier.
  const uint32_t sums = inclusive_warp_sum(lane < warps ? warp_sums[lane] : 0);
  const uint32_t in_front = __shfl_sync(kAll, sums, max(warp - 1, 0));
  return {saturating_add(warp > 0 ? in_front : 0, lane > 0 ? before : 0), __shfl_sync(kAll, sums, 31)};
}

// The tiles that a splat touches, packed into eight bytes that preprocess passes to fill. A small footprint, whose bounding box
// has at most 32 tiles, stores one bit per tile, row by row. A large footprint stores only the box; each kernel recomputes its
// tiles from the record with the whole warp. Both words are 0 if no tile is touched.
//   small: x = width - 1 (5 bits from 26) | top (13 bits from 13) | left (13 bits), y = the bits
//   large: x = 1 << 31 | top | left,                                                 y = bottom (13 bits from 13) | right - 1
struct Footprint {
  uint32_t x, y;

  __device__ bool large() const { return x >> 31; }
  __device__ int left() const { return int(x & 0x1fff); }
  __device__ int top() const { return int(x >> 13 & 0x1fff); }
  __device__ int width() const { return int(x >> 26 & 31) + 1; }
  __device__ int small_count() const { return large() ? 0 : __popc(y); }
};

// The contour alpha = 1/255 in the record's units, slightly enlarged: -(a dx^2 + b dx dy + c dy^2) = l - log2(1/255).
__device__ inline TileEllipse ellipse_of_record(const float4& xyab, float c, float l) {
  return tile_ellipse(xyab.x, xyab.y, -xyab.z, -0.5f * xyab.w, -c, l + (7e-4f - kLog2AlphaCutoff));
}

// Return the tiles that the ellipse of `box` touches, or the box itself if it has more than 32 tiles; {0, 0} if none.
__device__ inline Footprint footprint_of(const TileBox& box) {
  const int width = box.right - box.left, height = box.bottom - box.top;
  if (width <= 0 || height <= 0) return {0, 0};
  const uint32_t corner = uint32_t(box.top) << 13 | uint32_t(box.left);
  if (int64_t(width) * height > 32) return {1u << 31 | corner, uint32_t(box.bottom) << 13 | uint32_t(box.right - 1)};
  uint32_t bits = 0;
  for (int row = 0; row < height; ++row) {
    const TileRun run = tile_run(box, box.top + row, kTile);
    if (run.first < run.end) bits |= (kAll >> (32 - (run.end - run.first))) << (row * width + run.first - box.left);
  }
  return bits != 0 ? Footprint{uint32_t(width - 1) << 26 | corner, bits} : Footprint{0, 0};
}

// Call visit(tile, j) for each tile of a small footprint, with its number j.
template <class Visit>
__device__ inline void for_each_small_tile(const Footprint& footprint, int tile_width, const Visit& visit) {
  const int width = footprint.width(), first = footprint.top() * tile_width + footprint.left();
  // i / width == i * inverse >> 10 for i < 32, independent of the rounding of the reciprocal.
  const int inverse = int(1024 * reciprocal(float(width))) + 1;
  int j = 0;
  for (uint32_t bits = footprint.large() ? 0 : footprint.y; bits != 0; bits &= bits - 1, ++j) {
    const int i = __ffs(int(bits)) - 1, row = i * inverse >> 10;
    visit(first + i + row * (tile_width - width), j);
  }
}

// Call visit(tile, j) for the tiles of lane `owner`'s large footprint, whose record is `records[splat]`. The whole warp
// must call it; the tiles are distributed over the lanes. Returns the number of tiles.
template <class Visit>
__device__ inline int for_each_large_tile(const Footprint& mine, const Record<4>* records, int64_t splat, int owner,
                                          int tile_width, const Visit& visit) {
  const int lane = threadIdx.x & 31;
  const Footprint f = {__shfl_sync(kAll, mine.x, owner), __shfl_sync(kAll, mine.y, owner)};
  const Record<4>& r = records[__shfl_sync(kAll, splat, owner)];
  const TileBox box = {f.left(), f.top(), int(f.y & 0x1fff) + 1, int(f.y >> 13 & 0x3fff), ellipse_of_record(r.xyab, r.c, r.l)};
  int total = 0;
  for (int first_row = box.top; first_row < box.bottom; first_row += 32) {
    const TileRun run = first_row + lane < box.bottom ? tile_run(box, first_row + lane, kTile) : TileRun{0, 0};
    const int length = max(run.end - run.first, 0);
    int through = length;  // tiles of this row and the preceding rows
    for (int step = 1; step < 32; step *= 2) {
      const int before = __shfl_up_sync(kAll, through, step);
      if (lane >= step) through += before;
    }
    for (int row = 0; row < 32 && first_row + row < box.bottom; ++row) {
      const int first = __shfl_sync(kAll, run.first, row), count = __shfl_sync(kAll, length, row);
      const int start = total + __shfl_sync(kAll, through, row) - count, tile = (first_row + row) * tile_width + first;
      for (int column = lane; column < count; column += 32) visit(tile + column, start + column);
    }
    total += __shfl_sync(kAll, through, 31);
  }
  return total;
}

// Write the key of one instance. `place` is the position in the shared buffer or in the tile's segment; `instance` is
// the instance number when training.
template <Mode mode>
__device__ inline void emit_instance(const Lists& lists, int tile, uint32_t place, uint32_t depth, int64_t splat,
                                     uint32_t instance) {
  if constexpr (mode == kSegments) {
    const uint32_t segment = uint32_t(lists.segment);
    if (place < segment) lists.keys[uint32_t(tile) * segment + place] = uint64_t(depth) << 32 | uint32_t(splat);
    return;
  }
  const uint32_t capacity = uint32_t(lists.capacity);
  if constexpr (mode == kTraining) {
    if (instance < capacity) lists.instance_splats[instance] = int32_t(splat);
  }
  if (place >= capacity) return;
  const uint32_t number = mode == kTraining ? instance : uint32_t(splat);
  lists.keys[place] = mode == kTraining && instance >= capacity ? ~0ull : uint64_t(depth) << 32 | number;
}

__device__ inline Footprint load_footprint(const Scene& in, const Scratch& scratch, int64_t n) {
  if (n >= in.count) return {0, 0};
  const uint2 words = scratch.footprints[n];
  return {words.x, words.y};
}

// Call visit(owner) for each lane with a large footprint. The whole warp must call it.
template <class Visit>
__device__ inline void for_each_large(const Footprint& footprint, const Visit& visit) {
  for (unsigned large = __ballot_sync(kAll, footprint.large()); large != 0; large &= large - 1) visit(__ffs(int(large)) - 1);
}

// Return the number of tiles that each lane's splat touches. The whole warp must call it.
__device__ inline uint32_t count_tiles(const Scene& in, const Record<4>* records, const Footprint& footprint, int64_t n) {
  uint32_t tiles = uint32_t(footprint.small_count());
  for_each_large(footprint, [&](int owner) {
    const int count = for_each_large_tile(footprint, records, n, owner, in.tile_width, [](int, int) {});
    if (int(threadIdx.x & 31) == owner) tiles = uint32_t(count);
  });
  return tiles;
}

// Store the first instance of splat `n`, and after the last splat the number of instances.
__device__ inline void store_start(const Scene& in, const Lists& lists, int64_t n, uint32_t start, uint32_t end) {
  if (n < in.count) lists.splat_starts[n] = int32_t(start);
  if (n == in.count - 1) lists.splat_starts[n + 1] = int32_t(end);
}

// Reserve and return the next position in a tile's list.
__device__ inline uint32_t reserve(const Scratch& scratch, int tile) {
  return atomicAdd(scratch.counters + tile * scratch.counter_stride, 1u);
}

constexpr int kMaxSmallTiles = 32 * 32;  // maximum number of tiles in a warp's small footprints
constexpr int kInFlight = 4;             // atomic reservations in flight per thread

// Emit the instances of a warp's small footprints. Splats touch 1 to 32 tiles. To balance the lanes, the (splat, tile)
// pairs are first listed in `touched`, shared memory for kMaxSmallTiles entries, and then distributed evenly.
template <Mode mode>
__device__ inline void emit_small(const Scene& in, const Lists& lists, const Scratch& scratch, const Footprint& footprint,
                                  int64_t n, uint32_t depth, uint32_t start, uint32_t* touched) {
  const int lane = threadIdx.x & 31, small = footprint.small_count();
  const int through = int(inclusive_warp_sum(uint32_t(small))), first = through - small, all = __shfl_sync(kAll, through, 31);
  for_each_small_tile(footprint, in.tile_width,
                      [&](int tile, int j) { touched[first + j] = uint32_t(lane) << 26 | uint32_t(tile); });
  __syncwarp();
  for (int from = 0; from < all; from += 32 * kInFlight) {
    uint32_t place[kInFlight];
    int owner[kInFlight], tile[kInFlight];
#pragma unroll
    for (int k = 0; k < kInFlight; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t entry = i < all ? touched[i] : 0;
      owner[k] = int(entry >> 26);
      tile[k] = int(entry & 0x3ffffff);
      if (i < all) place[k] = reserve(scratch, tile[k]);
    }
#pragma unroll
    for (int k = 0; k < kInFlight; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t its_depth = __shfl_sync(kAll, depth, owner[k]);
      const uint32_t instance = __shfl_sync(kAll, start - uint32_t(first), owner[k]) + uint32_t(i);
      if (i < all) emit_instance<mode>(lists, tile[k], place[k], its_depth, n - lane + owner[k], instance);
    }
  }
}

// Emit the instances of a warp's large footprints.
template <Mode mode>
__device__ inline void emit_large(const Scene& in, const Lists& lists, const Scratch& scratch, const Footprint& footprint,
                                  int64_t n, uint32_t depth, uint32_t start) {
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  for_each_large(footprint, [&](int owner) {
    const uint32_t its_depth = __shfl_sync(kAll, depth, owner), its_start = __shfl_sync(kAll, start, owner);
    const int64_t splat = n - int(threadIdx.x & 31) + owner;
    for_each_large_tile(footprint, records, n, owner, in.tile_width, [&](int tile, int j) {
      emit_instance<mode>(lists, tile, reserve(scratch, tile), its_depth, splat, its_start + uint32_t(j));
    });
  });
}

}  // namespace

}  // namespace gsplat::frame
