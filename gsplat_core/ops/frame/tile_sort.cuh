// Sort of the 64-bit keys of one tile by a block of 128 threads. Evenly spread depths are sorted by buckets in shared
// memory. Otherwise a bitonic sort runs in registers, shared memory or global memory, depending on the length.
#pragma once

#include "../blending/splats.cuh"

namespace gsplat::frame {
namespace {

using namespace blending;

constexpr int kSortKeys = 2048;      // maximum number of keys sorted in shared memory
constexpr int kMaxKeysOfThread = 8;  // maximum number of keys per thread in registers

__device__ inline void compare_exchange(uint64_t& a, uint64_t& b, bool ascending) {
  const uint64_t x = a, y = b;
  const bool swap = (x > y) == ascending;
  a = swap ? y : x;
  b = swap ? x : y;
}

// Bitonic sort (Batcher 1968) in registers with shuffles; thread t holds keys [t kEach, (t + 1) kEach). `shared` has
// 256 kEach keys and may be reused after the next barrier. Keys from `count` on must be the largest.
template <int kEach>
__device__ inline void sort_in_registers(uint64_t (&keys)[kEach], int count, uint64_t* shared) {
  const int t = threadIdx.x;
#pragma unroll
  for (int size = 2; size < kEach; size *= 2)
#pragma unroll
    for (int distance = size / 2; distance > 0; distance /= 2)
#pragma unroll
      for (int i = 0; i < kEach; ++i)
        if ((i & distance) == 0) compare_exchange(keys[i], keys[i | distance], (i & size) == 0);
  // From here on, neighbouring keys are in other threads: `size` and `step` count threads.
  for (int size = 1; size <= kBlockThreads && size * kEach < 2 * count; size *= 2) {
    const bool ascending = (t & size) == 0;
    for (int step = size / 2; step > 0; step /= 2) {
      const bool keep_less = ascending == ((t & step) == 0);
      uint64_t others[kEach];
      if (step >= 32) {
        uint64_t* const half = shared + (step == size / 2 && size == kBlockThreads ? kEach * kBlockThreads : 0);
        for (int i = 0; i < kEach; ++i) half[i * kBlockThreads + t] = keys[i];
        __syncthreads();  // one barrier suffices: the next exchange uses the other half
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
        if ((i & distance) == 0) compare_exchange(keys[i], keys[i | distance], ascending);
  }
}

// In shared and global memory all exchanges sort in the same direction, so the length need not be a power of two:
// padding keys past the end would never move.
__device__ inline void exchange(uint64_t* keys, int64_t low, int64_t high, int64_t count) {
  if (high >= count) return;
  const uint64_t a = keys[low], b = keys[high];
  if (a > b) keys[low] = b, keys[high] = a;
}

// Pairs within 64 keys belong to one warp, because 32 consecutive pairs do.
__device__ inline void barrier_after(int distance) {
  if (distance > 32) {
    __syncthreads();
  } else {
    __syncwarp();
  }
}

// Merge step of the bitonic sort: compare and exchange keys at `distance`, distance / 2, ..., 1.
__device__ inline void merge_down(uint64_t* keys, int count, int pairs, int distance) {
  for (; distance > 0; distance /= 2) {
    for (int i = threadIdx.x; i < pairs; i += int(blockDim.x)) {
      const int low = 2 * i - (i & (distance - 1));
      exchange(keys, low, low + distance, count);
    }
    barrier_after(distance);
  }
}

// Sort `keys` in shared memory, which were written before the last barrier. Ends with a barrier if it sorts anything.
__device__ inline void sort_shared(uint64_t* keys, int count) {
  if (count < 2) return;
  const int pairs = 1 << (31 - __clz(count - 1));  // half of the next power of two
  for (int half = 1; half <= pairs; half *= 2) {
    for (int i = threadIdx.x; i < pairs; i += int(blockDim.x)) {
      const int within = i & (half - 1), first = 2 * (i - within);
      exchange(keys, first + within, first + 2 * half - 1 - within, count);
    }
    barrier_after(half);
    merge_down(keys, count, pairs, half / 2);
    if (half >= 32) __syncthreads();  // the next exchanges cross warps
  }
  __syncthreads();
}

// Sort more than kSortKeys keys in global memory with one block, using shared memory for kSortKeys keys.
__device__ inline void sort_long(uint64_t* keys, int64_t count, uint64_t* shared) {
  const auto in_chunks = [&](const auto& sort) {
    for (int64_t first = 0; first < count; first += kSortKeys) {
      const int length = int(count - first < kSortKeys ? count - first : kSortKeys);
      for (int i = threadIdx.x; i < length; i += int(blockDim.x)) shared[i] = keys[first + i];
      __syncthreads();
      sort(length);
      for (int i = threadIdx.x; i < length; i += int(blockDim.x)) keys[first + i] = shared[i];
      __syncthreads();
    }
  };
  in_chunks([&](int length) { sort_shared(shared, length); });
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
    in_chunks([&](int length) {
      merge_down(shared, length, kSortKeys / 2, kSortKeys / 2);
      __syncthreads();
    });
  }
}

constexpr int kBuckets = 512;
constexpr uint32_t kMaxInBucket = 12;  // with more keys in one bucket the bitonic sort is faster

struct BucketShared {
  uint32_t counts[kBuckets], starts[kBuckets];
  uint32_t smallest[kWarps], largest[kWarps];
  uint64_t keys[kBlockThreads * kMaxKeysOfThread];
};

__device__ inline uint32_t exclusive_warp_sum(uint32_t mine) {
  uint32_t through = mine;
#pragma unroll
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAll, through, step);
    if (int(threadIdx.x & 31) >= step) through += before;
  }
  return through - mine;
}

// Sort the keys of a tile whose depths are spread evenly: by depth into buckets, then by counting within each bucket.
// Thread t holds keys i kBlockThreads + t < `count`. Writes the keys' low words to `numbers` in key order, or returns
// false to all threads; in both cases a barrier must follow. The result depends neither on the input order nor on the
// order of the atomics, except among equal keys.
template <int kEach>
__device__ inline bool sort_by_buckets(const uint64_t (&keys)[kEach], int count, BucketShared& shared, uint32_t* numbers) {
  constexpr int kOfLane = kBuckets / 32;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const auto mine = [&](int i) { return i * kBlockThreads + int(threadIdx.x) < count; };
  const auto depth = [&](int i) { return uint32_t(keys[i] >> 32); };
  uint32_t smallest = ~0u, largest = 0;
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    smallest = min(smallest, depth(i));
    largest = max(largest, depth(i));
  }
  smallest = __reduce_min_sync(kAll, smallest);
  largest = __reduce_max_sync(kAll, largest);
  if (lane == 0) shared.smallest[warp] = smallest, shared.largest[warp] = largest;
  reinterpret_cast<uint4*>(shared.counts)[threadIdx.x] = {};
  static_assert(kBuckets == 4 * kBlockThreads);
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kWarps; ++i) {
    smallest = min(smallest, shared.smallest[i]);
    largest = max(largest, shared.largest[i]);
  }
  const float per_depth = (kBuckets - 1) * reciprocal(fmaxf(float(largest - smallest), 1));
  uint32_t buckets[kEach], places[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    buckets[i] = min(uint32_t(float(depth(i) - smallest) * per_depth), uint32_t(kBuckets - 1));
    places[i] = atomicAdd(&shared.counts[buckets[i]], 1u);
  }
  __syncthreads();
  // Every warp computes the prefix sums of all counts, and stores its part.
  uint32_t counts[kOfLane], total = 0, most = 0;
#pragma unroll
  for (int i = 0; i < kOfLane; i += 4) {
    const uint4 four = reinterpret_cast<const uint4*>(shared.counts)[(kOfLane * lane + i) / 4];
    counts[i] = four.x, counts[i + 1] = four.y, counts[i + 2] = four.z, counts[i + 3] = four.w;
  }
#pragma unroll
  for (const uint32_t in_bucket : counts) total += in_bucket, most = max(most, in_bucket);
  if (__reduce_max_sync(kAll, most) > kMaxInBucket) return false;
  uint32_t start = exclusive_warp_sum(total);
  if (lane / (32 / kWarps) == warp)
#pragma unroll
    for (int i = 0; i < kOfLane; ++i) {
      shared.starts[kOfLane * lane + i] = start;
      start += counts[i];
    }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i)
    if (mine(i)) shared.keys[shared.starts[buckets[i]] + places[i]] = keys[i];
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    if (!mine(i)) continue;
    const uint32_t first = shared.starts[buckets[i]], end = first + shared.counts[buckets[i]], own = first + places[i];
    uint32_t place = first;
#pragma unroll 1
    for (uint32_t j = first; j < end; ++j) {
      const uint64_t other = shared.keys[j];
      if (other < keys[i] || (other == keys[i] && j < own)) ++place;  // after an overflow a list may contain equal keys
    }
    numbers[place] = uint32_t(keys[i]);
  }
  return true;
}

// A block's shared memory: the keys during sorting, then the sorted ids and the staged splats.
template <class Stage>
union BlendShared {
  uint64_t keys[kSortKeys];
  struct {
    uint32_t ids[kBlockThreads * kMaxKeysOfThread];
    union {
      BucketShared buckets;
      Stage stage;
    };
  };
};

// Low words of a tile's keys in depth order (splats, or instances when training); in shared memory if they fit.
struct SortedIds {
  const uint32_t* first;
  int stride;
  __device__ uint32_t operator[](int i) const { return first[i * stride]; }
};

template <int kEach, class Stage>
__device__ inline void sort_short(const uint64_t* keys, int length, BlendShared<Stage>& shared) {
  uint64_t mine[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    const int at = i * kBlockThreads + int(threadIdx.x);
    mine[i] = at < length ? keys[at] : ~0ull;
  }
  if (sort_by_buckets(mine, length, shared.buckets, shared.ids)) return;
  __syncthreads();
  sort_in_registers<kEach>(mine, length, shared.keys);
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i) shared.ids[int(threadIdx.x) * kEach + i] = uint32_t(mine[i]);
}

// Sort a tile's keys by depth. Ends with a barrier.
template <class Stage>
__device__ inline SortedIds sort_tile(uint64_t* keys, int length, BlendShared<Stage>& shared) {
  SortedIds sorted = {shared.ids, 1};
  if (length <= kBlockThreads) {
    sort_short<1>(keys, length, shared);
  } else if (length <= 2 * kBlockThreads) {
    sort_short<2>(keys, length, shared);
  } else if (length <= 4 * kBlockThreads) {
    sort_short<4>(keys, length, shared);
  } else if (length <= kMaxKeysOfThread * kBlockThreads) {
    sort_short<kMaxKeysOfThread>(keys, length, shared);
  } else {
    sort_long(keys, length, shared.keys);
    sorted = {reinterpret_cast<const uint32_t*>(keys), 2};  // little-endian
  }
  __syncthreads();
  return sorted;
}

}  // namespace

}  // namespace gsplat::frame
