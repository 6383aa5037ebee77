// Tile lists between preprocess and blend: prefix sums of the counts, then the keys. Also accumulates the status of
// consecutive frames.
#include "dependent_launch.cuh"
#include "instances.cuh"

namespace gsplat::frame {
namespace {

// Single-pass prefix sum (decoupled look-back, Merrill and Garland 2016). A block publishes the sum of its kScanThreads
// counts, then adds the sums published by the preceding blocks.
struct Counts {
  uint32_t* counts;  // [count, stride]
  uint32_t* starts;  // [count]: sum of the preceding counts
  uint64_t* states;  // [blocks], zeroed: per block 1 << 63 | largest count << 32 | sum
  int64_t count;
  int32_t stride;
  bool in_place;  // also overwrite the counts with the starts

  __host__ __device__ int64_t blocks() const { return (count + kScanThreads - 1) / kScanThreads; }
};

struct Total {
  uint32_t sum, most;
};

__device__ inline Total unpack(uint64_t state) { return {uint32_t(state) & kMaxSum, uint32_t(state >> 32) & kMaxSum}; }

// Return the prefix sum of the counts of one block. The returned total is valid only in the first thread of the last
// block.
__device__ inline Total scan_part(const Counts& in, int64_t block) {
  __shared__ uint32_t warp_sums[32], warp_maxima[32];
  __shared__ Total preceding;
  const int64_t i = block * kScanThreads + threadIdx.x;
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  const uint32_t value = i < in.count ? in.counts[i * in.stride] : 0, most = __reduce_max_sync(kAll, value);
  if (lane == 0) warp_maxima[warp] = most;
  const BlockSum sum = sum_over_block(value, warp_sums);
  Total all = {};
  if (warp == 0) {
    const uint32_t longest_here = __reduce_max_sync(kAll, warp_maxima[lane]);
    volatile uint64_t* const states = in.states;
    if (lane == 0) states[block] = uint64_t(1) << 63 | uint64_t(longest_here) << 32 | sum.all;
    Total before = {};
    for (int64_t other = lane; other < block; other += 32) {
      uint64_t state = 0;
      while ((state = states[other]) >> 63 == 0) {
      }
      const Total its = unpack(state);
      before = {saturating_add(before.sum, its.sum), max(before.most, its.most)};
    }
    before.sum = __shfl_sync(kAll, inclusive_warp_sum(before.sum), 31);
    before.most = __reduce_max_sync(kAll, before.most);
    if (lane == 0) preceding = before;
    all = {saturating_add(before.sum, sum.all), max(before.most, longest_here)};
  }
  __syncthreads();
  if (i < in.count) {
    const uint32_t start = saturating_add(preceding.sum, sum.before);
    in.starts[i] = start;
    if (in.in_place) in.counts[i * in.stride] = start;
  }
  return all;
}

// Compute prefix sums: the first blocks of the tiles' counts, the remaining ones, when training, of the Gaussian blocks'.
__global__ void __launch_bounds__(kScanThreads) scan_counts(Lists lists, Counts tiles, Counts splats) {
  allow_dependent_launch();
  wait_for_preceding_kernel();
  const int64_t block = blockIdx.x, tile_blocks = tiles.blocks();
  if (block >= tile_blocks) {
    scan_part(splats, block - tile_blocks);
    return;
  }
  const Total all = scan_part(tiles, block);
  if (block + 1 < tile_blocks || threadIdx.x > 0) return;
  lists.tile_offsets[tiles.count] = int32_t(all.sum);
  lists.status[kStatusNeeded] = int32_t(all.sum);
  lists.status[kStatusLongest] = int32_t(all.most);
  lists.status[kStatusOverflow] = all.sum > lists.capacity;
  lists.status[kStatusOverflow + 1] = 0;
}

// Write one key per instance, in any order within a tile: sorting makes the order reproducible.
template <bool training>
__global__ void __launch_bounds__(kGaussianThreads) fill_lists(Scene in, Lists lists, Scratch scratch) {
  allow_dependent_launch();
  wait_for_preceding_kernel();
  __shared__ uint32_t touched[kGaussianThreads / 32][kMaxSmallTiles];
  const int64_t n = int64_t(blockIdx.x) * kGaussianThreads + threadIdx.x;
  const Footprint footprint = load_footprint(in, scratch, n);
  const uint32_t depth = footprint.y != 0 ? scratch.depths[n] : 0;
  uint32_t start = 0;
  if constexpr (training) {
    __shared__ uint32_t warp_sums[32];
    const uint32_t tiles = count_tiles(in, static_cast<const Record<4>*>(lists.records), footprint, n);
    start = saturating_add(scratch.block_starts[blockIdx.x], sum_over_block(tiles, warp_sums).before);
    store_start(in, lists, n, start, saturating_add(start, tiles));
  }
  constexpr Mode mode = training ? kTraining : kShared;
  emit_small<mode>(in, lists, scratch, footprint, n, depth, start, touched[threadIdx.x / 32]);
  emit_large<mode>(in, lists, scratch, footprint, n, depth, start);
}

__global__ void no_splats(int32_t* splat_starts) { splat_starts[0] = 0; }

__global__ void accumulate(const int32_t* status, int32_t* totals, int64_t* step, float* fits) {
  const int32_t overflow = status[kStatusOverflow] != 0;
  if (threadIdx.x == 0) {
    *step += 1 - overflow;
    *fits = float(1 - overflow);
  }
  const int i = int(threadIdx.x);
  totals[i] = i == kStatusOverflow ? totals[i] + overflow : max(totals[i], status[i]);
}

}  // namespace

void scan(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream) {
  const int64_t blocks = scratch.block_counts != nullptr ? blocks_for(in.count, kGaussianThreads) : 0;
  uint32_t* const offsets = reinterpret_cast<uint32_t*>(lists.tile_offsets);
  const Counts tiles = {scratch.counters, offsets, scratch.scan_states, in.tiles(), scratch.counter_stride, true};
  const Counts splats = {scratch.block_counts, scratch.block_starts, scratch.scan_states + tiles.blocks(), blocks, 1, false};
  launch_dependent(scan_counts, unsigned(tiles.blocks() + splats.blocks()), kScanThreads, stream, 0, lists, tiles, splats);
}

void fill(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream) {
  const bool training = lists.splat_starts != nullptr;
  if (in.count == 0) {
    if (training) no_splats<<<1, 1, 0, stream>>>(lists.splat_starts);
    return;
  }
  const auto kernel = training ? fill_lists<true> : fill_lists<false>;
  launch_dependent(kernel, blocks_for(in.count, kGaussianThreads), kGaussianThreads, stream, 0, in, lists, scratch);
}

void accumulate_status(const int32_t* status, int32_t* totals, int64_t* step, float* fits, cudaStream_t stream) {
  accumulate<<<1, kStatusSize, 0, stream>>>(status, totals, step, fits);
}

}  // namespace gsplat::frame
