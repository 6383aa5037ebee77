// Counting the tiles that a warp's splats touch, and writing the keys of their instances.
#pragma once

#include "frame_footprint.cuh"
#include "frame_sums.cuh"

namespace {

// Notes one instance. `place` is in the lists or in the tile's room, `instance` is its number when training.
template <ListKind kind>
__device__ inline void put_instance(const FrameLists& lists, int tile, uint32_t place, uint32_t depth, int64_t splat,
                                    uint32_t instance) {
  if constexpr (kind == kPerTile) {
    const uint32_t room = uint32_t(lists.tile_capacity);
    if (place < room) lists.keys[uint32_t(tile) * room + place] = uint64_t(depth) << 32 | uint32_t(splat);
    return;
  }
  const uint32_t capacity = uint32_t(lists.capacity);
  if constexpr (kind == kTraining) {
    if (instance < capacity) lists.instance_splats[instance] = int32_t(splat);
  }
  if (place >= capacity) return;
  const uint32_t number = kind == kTraining ? instance : uint32_t(splat);
  lists.keys[place] = kind == kTraining && instance >= capacity ? ~0ull : uint64_t(depth) << 32 | number;
}

__device__ inline Footprint load_footprint(const FrameScene& in, const FrameScratch& scratch, int64_t n) {
  if (n >= in.count) return {0, 0};
  const uint2 words = scratch.footprints[n];
  return {words.x, words.y};
}

// visit(owner) for each lane with a large footprint, by the whole warp.
template <class Visit>
__device__ inline void for_large_owners(const Footprint& footprint, const Visit& visit) {
  for (unsigned large = __ballot_sync(kAll, footprint.large()); large != 0; large &= large - 1) visit(__ffs(int(large)) - 1);
}

// How many tiles a lane's splat touches; by the whole warp.
__device__ inline uint32_t count_tiles(const FrameScene& in, const Record<4>* records, const Footprint& footprint, int64_t n) {
  uint32_t tiles = uint32_t(footprint.small_count());
  for_large_owners(footprint, [&](int owner) {
    const int count = for_large_tiles(footprint, records, n, owner, in.tile_width, [](int, int) {});
    if (int(threadIdx.x & 31) == owner) tiles = uint32_t(count);
  });
  return tiles;
}

// Where the instances of splat `n` start, and behind the last splat how many there are.
__device__ inline void store_start(const FrameScene& in, const FrameLists& lists, int64_t n, uint32_t start, uint32_t end) {
  if (n < in.count) lists.splat_starts[n] = int32_t(start);
  if (n == in.count - 1) lists.splat_starts[n + 1] = int32_t(end);
}

__device__ inline uint32_t reserve(const FrameScratch& scratch, int tile) {
  return atomicAdd(scratch.slots + tile * scratch.slot_stride, 1u);
}

constexpr int kMostSmall = 32 * 32;  // tiles of a warp's small footprints
constexpr int kAtOnce = 4;           // reservations of a thread that are on their way together

// Puts the instances of a warp's small footprints. A splat has one tile or thirty: they are written down in `touched` first and
// then dealt out evenly.
template <ListKind kind>
__device__ inline void put_small(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch,
                                 const Footprint& footprint, int64_t n, uint32_t depth, uint32_t start, uint32_t* touched) {
  const int lane = threadIdx.x & 31, small = footprint.small_count();
  const int through = int(sum_up_to_lane(uint32_t(small))), first = through - small, all = __shfl_sync(kAll, through, 31);
  for_small_tiles(footprint, in.tile_width, [&](int tile, int j) { touched[first + j] = uint32_t(lane) << 26 | uint32_t(tile); });
  __syncwarp();
  for (int from = 0; from < all; from += 32 * kAtOnce) {
    uint32_t place[kAtOnce];
    int owner[kAtOnce], tile[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t entry = i < all ? touched[i] : 0;
      owner[k] = int(entry >> 26);
      tile[k] = int(entry & 0x3ffffff);
      if (i < all) place[k] = reserve(scratch, tile[k]);
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t its_depth = __shfl_sync(kAll, depth, owner[k]);
      const uint32_t instance = __shfl_sync(kAll, start - uint32_t(first), owner[k]) + uint32_t(i);
      if (i < all) put_instance<kind>(lists, tile[k], place[k], its_depth, n - lane + owner[k], instance);
    }
  }
}

// Puts the instances of a warp's large footprints.
template <ListKind kind>
__device__ inline void put_large(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch,
                                 const Footprint& footprint, int64_t n, uint32_t depth, uint32_t start) {
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  for_large_owners(footprint, [&](int owner) {
    const uint32_t its_depth = __shfl_sync(kAll, depth, owner), its_start = __shfl_sync(kAll, start, owner);
    const int64_t splat = n - int(threadIdx.x & 31) + owner;
    for_large_tiles(footprint, records, n, owner, in.tile_width, [&](int tile, int j) {
      put_instance<kind>(lists, tile, reserve(scratch, tile), its_depth, splat, its_start + uint32_t(j));
    });
  });
}

}  // namespace
