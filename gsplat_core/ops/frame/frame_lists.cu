#include "frame_footprint.cuh"

namespace {

constexpr int kScanThreads = 1024;
constexpr int kScanEach = 4;
constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// The sums of all threads up to this one and of the whole block.
struct BlockSum {
  int64_t through, all;
};
__device__ inline BlockSum sum_over_block(int64_t value, int64_t* of_warps) {
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, warps = int(blockDim.x) / 32;
  for (int step = 1; step < 32; step *= 2) {
    const int64_t before = __shfl_up_sync(kAll, value, step);
    if (lane >= step) value += before;
  }
  if (lane == 31) of_warps[warp] = value;
  __syncthreads();
  if (warp == 0) {
    int64_t sum = lane < warps ? of_warps[lane] : 0;
    for (int step = 1; step < 32; step *= 2) {
      const int64_t before = __shfl_up_sync(kAll, sum, step);
      if (lane >= step) sum += before;
    }
    of_warps[lane] = sum;
  }
  __syncthreads();
  const BlockSum result = {value + (warp > 0 ? of_warps[warp - 1] : 0), of_warps[warps - 1]};
  __syncthreads();
  return result;
}

// write(i, the sum of counts in front of i) for i from 0 to count, by one block; returns the sum of all.
template <class Write>
__device__ inline int64_t scan_counts(const int32_t* counts, int64_t count, int& most, const Write& write) {
  __shared__ int64_t of_warps[32];
  int64_t in_front = 0;
  for (int64_t first = 0; first < count; first += kScanThreads * kScanEach) {
    int values[kScanEach];
    int64_t mine = 0;
    const int64_t at = first + threadIdx.x * kScanEach;
    for (int k = 0; k < kScanEach; ++k) {
      values[k] = at + k < count ? counts[at + k] : 0;
      most = max(most, values[k]);
      mine += values[k];
    }
    const BlockSum sum = sum_over_block(mine, of_warps);
    int64_t start = in_front + sum.through - mine;
    for (int k = 0; k < kScanEach; ++k) {
      if (at + k < count) write(at + k, start);
      start += values[k];
    }
    in_front += sum.all;
  }
  return in_front;
}

__device__ inline int32_t capped(int64_t value) { return int32_t(value < kMostInts ? value : kMostInts); }

// The first block has the tiles, the second one, when training, the blocks of Gaussians.
__global__ void __launch_bounds__(kScanThreads) scan(FrameScene in, FrameLists lists, FrameScratch scratch, int64_t blocks) {
  __shared__ int most_of_warps[32];
  int most = 0;
  if (blockIdx.x == 1) {
    scan_counts(scratch.sums, blocks, most, [&](int64_t i, int64_t start) { scratch.starts[i] = uint32_t(capped(start)); });
    return;
  }
  const int64_t all = scan_counts(scratch.counts, in.tiles(), most, [&](int64_t i, int64_t start) {
    lists.tile_offsets[i] = capped(start);
    scratch.cursors[i] = uint32_t(capped(start));
  });
  most = __reduce_max_sync(kAll, most);
  if (threadIdx.x % 32 == 0) most_of_warps[threadIdx.x / 32] = most;
  __syncthreads();
  if (threadIdx.x >= 32) return;
  most = __reduce_max_sync(kAll, most_of_warps[threadIdx.x]);
  if (threadIdx.x > 0) return;
  lists.tile_offsets[in.tiles()] = capped(all);
  lists.status[kStatusNeeded] = capped(all);
  lists.status[kStatusMost] = most;
  lists.status[kStatusCut] = all > lists.capacity;
  lists.status[kStatusCut + 1] = 0;
}

// One key per splat and tile, in any order within the tile: sorting puts them into the one that they have every time.
template <bool training>
__global__ void __launch_bounds__(kFrameThreads) fill(FrameScene in, FrameLists lists, FrameScratch scratch) {
  const int64_t n = int64_t(blockIdx.x) * kFrameThreads + threadIdx.x;
  const int lane = threadIdx.x & 31;
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  Footprint footprint = {0, 0};
  if (n < in.count) {
    const uint2 words = scratch.footprints[n];
    footprint = {words.x, words.y};
  }
  const uint32_t depth = footprint.y != 0 ? scratch.depths[n] : 0;
  const unsigned any_large = __ballot_sync(kAll, footprint.large());
  uint32_t start = 0;
  if constexpr (training) {
    __shared__ int64_t of_warps[32];
    int tiles = footprint.small_count();
    for (unsigned large = any_large; large != 0; large &= large - 1) {
      const int owner = __ffs(int(large)) - 1;
      const int count = for_large_tiles(footprint, records, n, owner, in.tile_width, [](int, int) {});
      if (lane == owner) tiles = count;
    }
    const BlockSum sum = sum_over_block(tiles, of_warps);
    start = uint32_t(capped(scratch.starts[blockIdx.x] + sum.through - tiles));
    if (n < in.count) lists.splat_starts[n] = int32_t(start);
    if (n == in.count - 1) lists.splat_starts[n + 1] = capped(int64_t(start) + tiles);
  }
  const uint32_t capacity = uint32_t(lists.capacity);
  const auto emit = [&](int tile, uint32_t depth_bits, int64_t splat, uint32_t instance) {
    const uint32_t position = atomicAdd(scratch.cursors + tile, 1u);
    if constexpr (training) {
      if (instance < capacity) lists.instance_splats[instance] = int32_t(splat);
    }
    if (position >= capacity) return;
    const uint32_t number = training ? instance : uint32_t(splat);
    lists.keys[position] = training && instance >= capacity ? ~0ull : uint64_t(depth_bits) << 32 | number;
  };
  for_small_tiles(footprint, in.tile_width, [&](int tile, int j) { emit(tile, depth, n, start + uint32_t(j)); });
  for (unsigned large = any_large; large != 0; large &= large - 1) {
    const int owner = __ffs(int(large)) - 1;
    const uint32_t its_depth = __shfl_sync(kAll, depth, owner), its_start = __shfl_sync(kAll, start, owner);
    const int64_t splat = n - lane + owner;
    for_large_tiles(footprint, records, n, owner, in.tile_width,
                    [&](int tile, int j) { emit(tile, its_depth, splat, its_start + uint32_t(j)); });
  }
}

__global__ void no_splats(int32_t* splat_starts) { splat_starts[0] = 0; }

}  // namespace

void scan_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = scratch.sums != nullptr ? blocks_for(in.count, kFrameThreads) : 0;
  const unsigned parts = blocks > 0 ? 2 : 1;
  scan<<<parts, kScanThreads, 0, stream>>>(in, lists, scratch, blocks);
}

void fill_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const bool training = lists.splat_starts != nullptr;
  if (in.count == 0) {
    if (training) no_splats<<<1, 1, 0, stream>>>(lists.splat_starts);
    return;
  }
  const auto kernel = training ? fill<true> : fill<false>;
  kernel<<<blocks_for(in.count, kFrameThreads), kFrameThreads, 0, stream>>>(in, lists, scratch);
}
