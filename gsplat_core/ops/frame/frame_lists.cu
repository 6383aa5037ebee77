#include "frame_emit.cuh"
#include "frame_launch.cuh"
#include "frame_sums.cuh"

namespace {

// Counts to sum up: each block has kScanThreads of them and adds what the blocks in front of it have published.
struct Counts {
  uint32_t* counts;  // [count, stride]
  uint32_t* starts;  // [count]: the sum of the counts in front
  uint64_t* states;  // [blocks], zero before: a block's 1 << 63 | greatest count << 32 | sum
  int64_t count;
  int32_t stride;
  bool in_place;  // also write the starts over the counts

  __host__ __device__ int64_t blocks() const { return (count + kScanThreads - 1) / kScanThreads; }
};

struct Total {
  uint32_t sum, most;
};

__device__ inline Total unpack(uint64_t state) { return {uint32_t(state) & kMost, uint32_t(state >> 32) & kMost}; }

// Returns, to the first thread of the last block, the total of all counts.
__device__ inline Total scan_part(const Counts& in, int64_t block) {
  __shared__ uint32_t of_warps[32], most_of_warps[32];
  __shared__ Total in_front;
  const int64_t i = block * kScanThreads + threadIdx.x;
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  const uint32_t value = i < in.count ? in.counts[i * in.stride] : 0, most = __reduce_max_sync(kAll, value);
  if (lane == 0) most_of_warps[warp] = most;
  const BlockSum sum = sum_over_block(value, of_warps);
  Total all = {};
  if (warp == 0) {
    const uint32_t most_here = __reduce_max_sync(kAll, most_of_warps[lane]);
    volatile uint64_t* const states = in.states;
    if (lane == 0) states[block] = uint64_t(1) << 63 | uint64_t(most_here) << 32 | sum.all;
    Total before = {};
    for (int64_t other = lane; other < block; other += 32) {
      uint64_t state = 0;
      while ((state = states[other]) >> 63 == 0) {
      }
      const Total its = unpack(state);
      before = {add(before.sum, its.sum), max(before.most, its.most)};
    }
    before.sum = __shfl_sync(kAll, sum_up_to_lane(before.sum), 31);
    before.most = __reduce_max_sync(kAll, before.most);
    if (lane == 0) in_front = before;
    all = {add(before.sum, sum.all), max(before.most, most_here)};
  }
  __syncthreads();
  if (i < in.count) {
    const uint32_t start = add(in_front.sum, sum.before);
    in.starts[i] = start;
    if (in.in_place) in.counts[i * in.stride] = start;
  }
  return all;
}

// The first blocks have the tiles, the others, when training, the blocks of Gaussians.
__global__ void __launch_bounds__(kScanThreads) scan(FrameLists lists, Counts tiles, Counts splats) {
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  const int64_t block = blockIdx.x, of_tiles = tiles.blocks();
  if (block >= of_tiles) {
    scan_part(splats, block - of_tiles);
    return;
  }
  const Total all = scan_part(tiles, block);
  if (block + 1 < of_tiles || threadIdx.x > 0) return;
  lists.tile_offsets[tiles.count] = int32_t(all.sum);
  lists.status[kStatusNeeded] = int32_t(all.sum);
  lists.status[kStatusMost] = int32_t(all.most);
  lists.status[kStatusCut] = all.sum > lists.capacity;
  lists.status[kStatusCut + 1] = 0;
}

// One key per splat and tile, in any order within the tile: sorting puts them into the one that they have every time.
template <bool training>
__global__ void __launch_bounds__(kFrameThreads) fill(FrameScene in, FrameLists lists, FrameScratch scratch) {
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  __shared__ uint32_t touched[kFrameThreads / 32][kMostSmall];
  const int64_t n = int64_t(blockIdx.x) * kFrameThreads + threadIdx.x;
  const Footprint footprint = load_footprint(in, scratch, n);
  const uint32_t depth = footprint.y != 0 ? scratch.depths[n] : 0;
  uint32_t start = 0;
  if constexpr (training) {
    __shared__ uint32_t of_warps[32];
    const uint32_t tiles = count_tiles(in, static_cast<const Record<4>*>(lists.records), footprint, n);
    start = add(scratch.starts[blockIdx.x], sum_over_block(tiles, of_warps).before);
    store_start(in, lists, n, start, add(start, tiles));
  }
  constexpr ListKind kind = training ? kTraining : kShared;
  put_small<kind>(in, lists, scratch, footprint, n, depth, start, touched[threadIdx.x / 32]);
  put_large<kind>(in, lists, scratch, footprint, n, depth, start);
}

__global__ void no_splats(int32_t* splat_starts) { splat_starts[0] = 0; }

}  // namespace

void scan_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = scratch.sums != nullptr ? blocks_for(in.count, kFrameThreads) : 0;
  uint32_t* const offsets = reinterpret_cast<uint32_t*>(lists.tile_offsets);
  const Counts tiles = {scratch.slots, offsets, scratch.states, in.tiles(), scratch.slot_stride, true};
  const Counts splats = {scratch.sums, scratch.starts, scratch.states + tiles.blocks(), blocks, 1, false};
  launch_behind(scan, unsigned(tiles.blocks() + splats.blocks()), kScanThreads, stream, 0, lists, tiles, splats);
}

void fill_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const bool training = lists.splat_starts != nullptr;
  if (in.count == 0) {
    if (training) no_splats<<<1, 1, 0, stream>>>(lists.splat_starts);
    return;
  }
  const auto kernel = training ? fill<true> : fill<false>;
  launch_behind(kernel, blocks_for(in.count, kFrameThreads), kFrameThreads, stream, 0, in, lists, scratch);
}
