#include "frame_footprint.cuh"
#include "frame_launch.cuh"

namespace {

constexpr int kScanThreads = 1024;
constexpr int kScanEach = 8;
constexpr uint32_t kMost = 0x7fffffffu;  // sums stop here: min(a + b, kMost) is associative

__device__ inline uint32_t add(uint32_t a, uint32_t b) { return min(a + b, kMost); }

// The sums of all threads up to this one and of the whole block. `of_warps` may be used again after the next barrier.
struct BlockSum {
  uint32_t before, all;
};
__device__ inline uint32_t sum_up_to_lane(uint32_t value) {
  for (int step = 1; step < 32; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAll, value, step);
    if ((threadIdx.x & 31) >= step) value = add(value, before);
  }
  return value;
}
__device__ inline BlockSum sum_over_block(uint32_t value, uint32_t* of_warps) {
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, warps = int(blockDim.x) / 32;
  const uint32_t through = sum_up_to_lane(value), before = __shfl_up_sync(kAll, through, 1);
  if (lane == 31) of_warps[warp] = through;
  __syncthreads();
  // Every warp sums the warps for itself, which saves a barrier.
  const uint32_t sums = sum_up_to_lane(lane < warps ? of_warps[lane] : 0);
  const uint32_t in_front = __shfl_sync(kAll, sums, max(warp - 1, 0));
  return {add(warp > 0 ? in_front : 0, lane > 0 ? before : 0), __shfl_sync(kAll, sums, 31)};
}

// write(i, the sum of the counts in front of i) for i from 0 to count - 1, by one block; returns the sum of all. `counts` begin
// at a multiple of 16 bytes and can be read to a multiple of 4 of them.
template <class Write>
__device__ inline uint32_t scan_counts(const int32_t* counts, int64_t count, uint32_t& most, const Write& write) {
  __shared__ uint32_t of_warps[2][32];
  uint32_t values[kScanEach];
  const auto load = [&](int64_t at) {
    for (int k = 0; k < kScanEach; k += 4) {
      if (at + k + 3 < count) {
        const int4 four = *reinterpret_cast<const int4*>(counts + at + k);
        values[k] = uint32_t(four.x), values[k + 1] = uint32_t(four.y);
        values[k + 2] = uint32_t(four.z), values[k + 3] = uint32_t(four.w);
      } else {
        for (int j = k; j < k + 4; ++j) values[j] = at + j < count ? uint32_t(counts[at + j]) : 0;
      }
    }
  };
  uint32_t in_front = 0;
  int64_t at = int64_t(threadIdx.x) * kScanEach;
  load(at);
  for (int64_t first = 0; first < count; first += kScanThreads * kScanEach, at += kScanThreads * kScanEach) {
    uint32_t starts[kScanEach], mine = 0;
    for (int k = 0; k < kScanEach; ++k) {
      starts[k] = mine;
      mine = add(mine, values[k]);
      most = max(most, values[k]);
    }
    load(at + kScanThreads * kScanEach);  // on its way meanwhile
    const BlockSum sum = sum_over_block(mine, of_warps[first / (kScanThreads * kScanEach) & 1]);
    const uint32_t before = add(in_front, sum.before);
    for (int k = 0; k < kScanEach; k += 4) {
      const uint4 four =
          make_uint4(add(before, starts[k]), add(before, starts[k + 1]), add(before, starts[k + 2]), add(before, starts[k + 3]));
      if (at + k < count) write(at + k, four);
    }
    in_front = add(in_front, sum.all);
  }
  return in_front;
}

// Those of the four that are in front of `count`.
__device__ inline void store_four(uint32_t* to, int64_t at, int64_t count, uint4 four) {
  if (at + 3 < count) {
    *reinterpret_cast<uint4*>(to + at) = four;
  } else {
    to[at] = four.x;
    if (at + 1 < count) to[at + 1] = four.y;
    if (at + 2 < count) to[at + 2] = four.z;
  }
}

// The first block has the tiles, the second one, when training, the blocks of Gaussians.
__global__ void __launch_bounds__(kScanThreads) scan(FrameScene in, FrameLists lists, FrameScratch scratch, int64_t blocks) {
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  __shared__ uint32_t most_of_warps[32];
  uint32_t most = 0;
  if (blockIdx.x == 1) {
    scan_counts(scratch.sums, blocks, most, [&](int64_t i, uint4 starts) { store_four(scratch.starts, i, blocks, starts); });
    return;
  }
  const uint32_t all = scan_counts(scratch.counts, in.tiles(), most, [&](int64_t i, uint4 starts) {
    store_four(reinterpret_cast<uint32_t*>(lists.tile_offsets), i, in.tiles(), starts);
    store_four(scratch.cursors, i, in.tiles(), starts);
  });
  most = __reduce_max_sync(kAll, most);
  if (threadIdx.x % 32 == 0) most_of_warps[threadIdx.x / 32] = most;
  __syncthreads();
  if (threadIdx.x >= 32) return;
  most = __reduce_max_sync(kAll, most_of_warps[threadIdx.x]);
  if (threadIdx.x > 0) return;
  lists.tile_offsets[in.tiles()] = int32_t(all);
  lists.status[kStatusNeeded] = int32_t(all);
  lists.status[kStatusMost] = int32_t(most);
  lists.status[kStatusCut] = all > lists.capacity;
  lists.status[kStatusCut + 1] = 0;
}

// Puts a key into the list of a tile.
template <bool training>
struct Emitter {
  const FrameLists& lists;
  const FrameScratch& scratch;

  __device__ uint32_t reserve(int tile) const { return atomicAdd(scratch.cursors + tile, 1u); }
  __device__ void put(uint32_t position, uint32_t depth, int64_t splat, uint32_t instance) const {
    const uint32_t capacity = uint32_t(lists.capacity);
    if constexpr (training) {
      if (instance < capacity) lists.instance_splats[instance] = int32_t(splat);
    }
    if (position >= capacity) return;
    const uint32_t number = training ? instance : uint32_t(splat);
    lists.keys[position] = training && instance >= capacity ? ~0ull : uint64_t(depth) << 32 | number;
  }
};

constexpr int kAtOnce = 4;  // reservations of a thread that are on their way together

// One key per splat and tile, in any order within the tile: sorting puts them into the one that they have every time.
template <bool training>
__global__ void __launch_bounds__(kFrameThreads) fill(FrameScene in, FrameLists lists, FrameScratch scratch) {
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  __shared__ uint32_t touched[kFrameThreads / 32][32 * 32];  // by each warp's small splats: lane << 26 | tile
  const int64_t n = int64_t(blockIdx.x) * kFrameThreads + threadIdx.x;
  const int lane = threadIdx.x & 31;
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  const Emitter<training> emitter = {lists, scratch};
  Footprint footprint = {0, 0};
  if (n < in.count) {
    const uint2 words = scratch.footprints[n];
    footprint = {words.x, words.y};
  }
  const uint32_t depth = footprint.y != 0 ? scratch.depths[n] : 0;
  const unsigned any_large = __ballot_sync(kAll, footprint.large());
  const int small = footprint.small_count();
  uint32_t start = 0;
  if constexpr (training) {
    __shared__ uint32_t of_warps[32];
    uint32_t tiles = uint32_t(small);
    for (unsigned large = any_large; large != 0; large &= large - 1) {
      const int owner = __ffs(int(large)) - 1;
      const int count = for_large_tiles(footprint, records, n, owner, in.tile_width, [](int, int) {});
      if (lane == owner) tiles = uint32_t(count);
    }
    start = add(scratch.starts[blockIdx.x], sum_over_block(tiles, of_warps).before);
    if (n < in.count) lists.splat_starts[n] = int32_t(start);
    if (n == in.count - 1) lists.splat_starts[n + 1] = int32_t(add(start, tiles));
  }

  // A splat has one tile or thirty: the warp's are written down first and then dealt out evenly.
  const int through = int(sum_up_to_lane(uint32_t(small))), first = through - small, all = __shfl_sync(kAll, through, 31);
  uint32_t* const list = touched[threadIdx.x / 32];
  for_small_tiles(footprint, in.tile_width, [&](int tile, int j) { list[first + j] = uint32_t(lane) << 26 | uint32_t(tile); });
  __syncwarp();
  for (int from = 0; from < all; from += 32 * kAtOnce) {
    uint32_t position[kAtOnce];
    int owner[kAtOnce];
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t entry = i < all ? list[i] : 0;
      owner[k] = int(entry >> 26);
      if (i < all) position[k] = emitter.reserve(int(entry & 0x3ffffff));
    }
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
      const int i = from + 32 * k + lane;
      const uint32_t its_depth = __shfl_sync(kAll, depth, owner[k]);
      const uint32_t instance = __shfl_sync(kAll, start - uint32_t(first), owner[k]) + uint32_t(i);
      if (i < all) emitter.put(position[k], its_depth, n - lane + owner[k], instance);
    }
  }

  for (unsigned large = any_large; large != 0; large &= large - 1) {
    const int owner = __ffs(int(large)) - 1;
    const uint32_t its_depth = __shfl_sync(kAll, depth, owner), its_start = __shfl_sync(kAll, start, owner);
    const int64_t splat = n - lane + owner;
    for_large_tiles(footprint, records, n, owner, in.tile_width,
                    [&](int tile, int j) { emitter.put(emitter.reserve(tile), its_depth, splat, its_start + uint32_t(j)); });
  }
}

__global__ void no_splats(int32_t* splat_starts) { splat_starts[0] = 0; }

}  // namespace

void scan_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = scratch.sums != nullptr ? blocks_for(in.count, kFrameThreads) : 0;
  const unsigned parts = blocks > 0 ? 2 : 1;
  launch_behind(scan, parts, kScanThreads, stream, in, lists, scratch, blocks);
}

void fill_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const bool training = lists.splat_starts != nullptr;
  if (in.count == 0) {
    if (training) no_splats<<<1, 1, 0, stream>>>(lists.splat_starts);
    return;
  }
  const auto kernel = training ? fill<true> : fill<false>;
  launch_behind(kernel, blocks_for(in.count, kFrameThreads), kFrameThreads, stream, in, lists, scratch);
}
