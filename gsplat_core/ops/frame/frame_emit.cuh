// Counting the tiles that a warp's splats touch, and writing the keys of their instances.
#pragma once

#include "frame_footprint.cuh"

namespace {

// Writes the key of one instance. `position` is in the lists, `instance` is its number when training.
template <bool training>
__device__ inline void put_key(const FrameLists& lists, uint32_t position, uint32_t depth, int64_t splat, uint32_t instance) {
  const uint32_t capacity = uint32_t(lists.capacity);
  if constexpr (training) {
    if (instance < capacity) lists.instance_splats[instance] = int32_t(splat);
  }
  if (position >= capacity) return;
  const uint32_t number = training ? instance : uint32_t(splat);
  lists.keys[position] = training && instance >= capacity ? ~0ull : uint64_t(depth) << 32 | number;
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

// For the tiles of a warp's large footprints: put_key at the position that reserve(tile) gives.
template <bool training, class Reserve>
__device__ inline void put_large(const FrameScene& in, const FrameLists& lists, const Footprint& footprint, int64_t n,
                                 uint32_t depth, uint32_t start, const Reserve& reserve) {
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  for_large_owners(footprint, [&](int owner) {
    const uint32_t its_depth = __shfl_sync(kAll, depth, owner), its_start = __shfl_sync(kAll, start, owner);
    const int64_t splat = n - int(threadIdx.x & 31) + owner;
    for_large_tiles(footprint, records, n, owner, in.tile_width,
                    [&](int tile, int j) { put_key<training>(lists, reserve(tile), its_depth, splat, its_start + uint32_t(j)); });
  });
}

}  // namespace
