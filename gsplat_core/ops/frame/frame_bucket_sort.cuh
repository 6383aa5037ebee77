// A block of 128 threads sorts the keys of one tile where their depths are spread evenly enough: into buckets by depth, then by
// counting within each.
#pragma once

#include "frame_sort.cuh"

namespace {

constexpr int kBuckets = 512;
constexpr uint32_t kMostInBucket = 12;  // else the general way is faster

struct BucketRoom {
  uint32_t counts[kBuckets], starts[kBuckets];
  uint32_t least[kWarps], greatest[kWarps];
  uint64_t keys[kBlockThreads * kMostInThread];
};

__device__ inline uint32_t sum_of_lanes_before(uint32_t mine) {
  uint32_t through = mine;
#pragma unroll
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAll, through, step);
    if (int(threadIdx.x & 31) >= step) through += before;
  }
  return through - mine;
}

// Thread t holds the keys at i kBlockThreads + t below `count`. Puts their low words into `numbers` in the order of the keys, or
// returns false to all threads; another barrier must follow in either case. The order that they come in does not matter, nor that
// of the atomic additions: only equal keys take their places by it.
template <int kEach>
__device__ inline bool sort_by_buckets(const uint64_t (&keys)[kEach], int count, BucketRoom& room, uint32_t* numbers) {
  constexpr int kOfLane = kBuckets / 32;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto mine = [&](int i) { return i * kBlockThreads + int(threadIdx.x) < count; };
  const auto depth = [&](int i) { return uint32_t(keys[i] >> 32); };
  uint32_t least = ~0u, greatest = 0;
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    least = min(least, depth(i));
    greatest = max(greatest, depth(i));
  }
  least = __reduce_min_sync(kAll, least);
  greatest = __reduce_max_sync(kAll, greatest);
  if (lane == 0) room.least[warp] = least, room.greatest[warp] = greatest;
  reinterpret_cast<uint4*>(room.counts)[threadIdx.x] = {};
  static_assert(kBuckets == 4 * kBlockThreads);
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kWarps; ++i) {
    least = min(least, room.least[i]);
    greatest = max(greatest, room.greatest[i]);
  }
  const float per_depth = (kBuckets - 1) * reciprocal(fmaxf(float(greatest - least), 1));
  uint32_t buckets[kEach], places[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    buckets[i] = min(uint32_t(float(depth(i) - least) * per_depth), uint32_t(kBuckets - 1));
    places[i] = atomicAdd(&room.counts[buckets[i]], 1u);
  }
  __syncthreads();
  // Every warp adds up all of the counts, and stores a part of what all know.
  uint32_t counts[kOfLane], total = 0, most = 0;
#pragma unroll
  for (int i = 0; i < kOfLane; i += 4) {
    const uint4 four = reinterpret_cast<const uint4*>(room.counts)[(kOfLane * lane + i) / 4];
    counts[i] = four.x, counts[i + 1] = four.y, counts[i + 2] = four.z, counts[i + 3] = four.w;
  }
#pragma unroll
  for (const uint32_t in_bucket : counts) total += in_bucket, most = max(most, in_bucket);
  if (__reduce_max_sync(kAll, most) > kMostInBucket) return false;
  uint32_t start = sum_of_lanes_before(total);
  if (lane / (32 / kWarps) == warp)
#pragma unroll
    for (int i = 0; i < kOfLane; ++i) {
      room.starts[kOfLane * lane + i] = start;
      start += counts[i];
    }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i)
    if (mine(i)) room.keys[room.starts[buckets[i]] + places[i]] = keys[i];
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    const uint32_t first = room.starts[buckets[i]], end = first + room.counts[buckets[i]], own = first + places[i];
    uint32_t place = first;
#pragma unroll 1
    for (uint32_t j = first; j < end; ++j) {
      const uint64_t other = room.keys[j];
      if (other < keys[i] || (other == keys[i] && j < own)) ++place;  // a list that was cut may hold equal ones
    }
    numbers[place] = uint32_t(keys[i]);
  }
  return true;
}

}  // namespace
