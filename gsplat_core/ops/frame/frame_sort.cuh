// A block of 128 threads sorts the keys of one tile, bitonic (Batcher 1968): short lists in registers, longer ones in shared
// memory, the longest in global memory with the help of shared memory.
#pragma once

#include "../compositing/blend_window.cuh"

namespace {

constexpr int kSortKeys = 2048;   // that a block sorts in shared memory
constexpr int kMostInThread = 8;  // keys that a thread sorts in registers

__device__ inline void put_in_order(uint64_t& a, uint64_t& b, bool ascending) {
  const uint64_t x = a, y = b;
  const bool swap = (x > y) == ascending;
  a = swap ? y : x;
  b = swap ? x : y;
}

// Thread t holds the keys t kEach and on. `room` is shared memory for 256 kEach keys, and may be used again after the next
// barrier. What is behind `count` must be the greatest keys.
template <int kEach>
__device__ inline void sort_in_registers(uint64_t (&keys)[kEach], int count, uint64_t* room) {
  const int t = threadIdx.x;
#pragma unroll
  for (int size = 2; size < kEach; size *= 2)
#pragma unroll
    for (int distance = size / 2; distance > 0; distance /= 2)
#pragma unroll
      for (int i = 0; i < kEach; ++i)
        if ((i & distance) == 0) put_in_order(keys[i], keys[i | distance], (i & size) == 0);
  // From here on, `size` and `step` count threads.
  for (int size = 1; size <= kBlockThreads && size * kEach < 2 * count; size *= 2) {
    const bool ascending = (t & size) == 0;
    for (int step = size / 2; step > 0; step /= 2) {
      const bool keep_less = ascending == ((t & step) == 0);
      uint64_t others[kEach];
      if (step >= 32) {
        uint64_t* const half = room + (step == size / 2 && size == kBlockThreads ? kEach * kBlockThreads : 0);
        for (int i = 0; i < kEach; ++i) half[i * kBlockThreads + t] = keys[i];
        __syncthreads();  // one is enough: the next exchange is in the other half
        for (int i = 0; i < kEach; ++i) others[i] = half[i * kBlockThreads + (t ^ step)];
      } else {
        for (int i = 0; i < kEach; ++i) others[i] = __shfl_xor_sync(kAll, keys[i], step);
      }
      for (int i = 0; i < kEach; ++i) keys[i] = (keys[i] < others[i]) == keep_less ? keys[i] : others[i];
    }
#pragma unroll
    for (int distance = kEach / 2; distance > 0; distance /= 2)
#pragma unroll
      for (int i = 0; i < kEach; ++i)
        if ((i & distance) == 0) put_in_order(keys[i], keys[i | distance], ascending);
  }
}

// In shared and global memory all exchanges go towards the front, so that a list need not be a power of two long: what would be
// behind its end never moves.
__device__ inline void exchange(uint64_t* keys, int64_t low, int64_t high, int64_t count) {
  if (high >= count) return;
  const uint64_t a = keys[low], b = keys[high];
  if (a > b) keys[low] = b, keys[high] = a;
}

// Pairs within 64 keys stay with one warp: 32 consecutive pairs are always one warp's.
__device__ inline void barrier_after(int distance) {
  if (distance > 32) {
    __syncthreads();
  } else {
    __syncwarp();
  }
}

// Exchanges at distance `distance` and then at half of it, down to 1.
__device__ inline void merge_down(uint64_t* keys, int count, int pairs, int distance) {
  for (; distance > 0; distance /= 2) {
    for (int i = threadIdx.x; i < pairs; i += int(blockDim.x)) {
      const int low = 2 * i - (i & (distance - 1));
      exchange(keys, low, low + distance, count);
    }
    barrier_after(distance);
  }
}

// `keys` in shared memory, written before the last barrier; sorted behind the barrier it ends with.
__device__ inline void sort_shared(uint64_t* keys, int count) {
  if (count < 2) return;
  const int pairs = 1 << (31 - __clz(count - 1));  // half of the power of two that holds them
  for (int half = 1; half <= pairs; half *= 2) {
    for (int i = threadIdx.x; i < pairs; i += int(blockDim.x)) {
      const int within = i & (half - 1), first = 2 * (i - within);
      exchange(keys, first + within, first + 2 * half - 1 - within, count);
    }
    barrier_after(half);
    merge_down(keys, count, pairs, half / 2);
    if (half >= 32) __syncthreads();  // the next exchanges are of two warps' keys
  }
  __syncthreads();
}

// `keys` in global memory, more than kSortKeys of them, by one block with kSortKeys of `shared`.
__device__ inline void sort_long(uint64_t* keys, int64_t count, uint64_t* shared) {
  const auto in_parts = [&](const auto& sort) {
    for (int64_t first = 0; first < count; first += kSortKeys) {
      const int length = int(count - first < kSortKeys ? count - first : kSortKeys);
      for (int i = threadIdx.x; i < length; i += int(blockDim.x)) shared[i] = keys[first + i];
      __syncthreads();
      sort(length);
      for (int i = threadIdx.x; i < length; i += int(blockDim.x)) keys[first + i] = shared[i];
      __syncthreads();
    }
  };
  in_parts([&](int length) { sort_shared(shared, length); });
  for (int64_t half = kSortKeys; half < count; half *= 2) {
    for (int64_t i = threadIdx.x;; i += blockDim.x) {
      const int64_t within = i & (half - 1), first = 2 * (i - within);
      if (first >= count) break;
      exchange(keys, first + within, first + 2 * half - 1 - within, count);
    }
    __syncthreads();
    for (int64_t distance = half / 2; distance >= kSortKeys; distance /= 2) {
      for (int64_t i = threadIdx.x;; i += blockDim.x) {
        const int64_t low = 2 * i - (i & (distance - 1));
        if (low >= count) break;
        exchange(keys, low, low + distance, count);
      }
      __syncthreads();
    }
    in_parts([&](int length) {
      merge_down(shared, length, kSortKeys / 2, kSortKeys / 2);
      __syncthreads();
    });
  }
}

}  // namespace
