// A block sorts the list of one tile: the general way and the one by buckets of depth, by the length of the list.
#pragma once

#include "frame_bucket_sort.cuh"
#include "frame_sort.cuh"

namespace {

// A block's shared memory: for sorting, then for the sorted numbers and for blending.
template <class Stage>
union BlendRoom {
  uint64_t keys[kSortKeys];
  struct {
    uint32_t numbers[kBlockThreads * kMostInThread];
    union {
      BucketRoom buckets;
      Stage stage;
    };
  };
};

// The low words of a tile's keys by depth: splats, or instances when training. In shared memory where they fit.
struct SortedNumbers {
  const uint32_t* first;
  int stride;
  __device__ uint32_t operator[](int i) const { return first[i * stride]; }
};

template <int kEach, class Stage>
__device__ inline void sort_short(const uint64_t* keys, int length, BlendRoom<Stage>& room) {
  uint64_t mine[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    const int at = i * kBlockThreads + int(threadIdx.x);
    mine[i] = at < length ? keys[at] : ~0ull;
  }
  if (sort_by_buckets(mine, length, room.buckets, room.numbers)) return;
  __syncthreads();
  sort_in_registers<kEach>(mine, length, room.keys);
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i) room.numbers[int(threadIdx.x) * kEach + i] = uint32_t(mine[i]);
}

// Ends with a barrier.
template <class Stage>
__device__ inline SortedNumbers sort_tile(uint64_t* keys, int length, BlendRoom<Stage>& room) {
  SortedNumbers sorted = {room.numbers, 1};
  if (length <= kBlockThreads) {
    sort_short<1>(keys, length, room);
  } else if (length <= 2 * kBlockThreads) {
    sort_short<2>(keys, length, room);
  } else if (length <= 4 * kBlockThreads) {
    sort_short<4>(keys, length, room);
  } else if (length <= kMostInThread * kBlockThreads) {
    sort_short<kMostInThread>(keys, length, room);
  } else {
    sort_long(keys, length, room.keys);
    sorted = {reinterpret_cast<const uint32_t*>(keys), 2};  // little-endian
  }
  __syncthreads();
  return sorted;
}

}  // namespace
