// Counting and filling the lists of large scenes: one block per multiprocessor has a chunk of the Gaussians and counts its tiles
// in shared memory, for two atomics in global memory per instance would take longer than all the rest of the lists.
#include "frame_emit.cuh"
#include "frame_launch.cuh"
#include "frame_sums.cuh"

namespace {

constexpr int kChunkThreads = 1024;
constexpr int kRowsAtOnce = 8;
constexpr int kPrefixWarps = 16;  // of a block of prefix_chunks

__device__ inline int64_t chunk_begin(const FrameScene& in, const FrameScratch& scratch) { return blockIdx.x * scratch.chunk; }
__device__ inline int64_t chunk_end(const FrameScene& in, const FrameScratch& scratch) {
  return min(in.count, int64_t(blockIdx.x + 1) * scratch.chunk);
}

// Writes how many instances each tile has of this chunk.
__global__ void __launch_bounds__(kChunkThreads) count_chunks(FrameScene in, FrameLists lists, FrameScratch scratch) {
  extern __shared__ uint32_t tiles[];
  __shared__ uint32_t of_warps[32];
  const int count = int(in.tiles());
  let_kernel_behind_come();
  for (int i = threadIdx.x; i < count; i += kChunkThreads) tiles[i] = 0;
  wait_for_kernel_in_front();
  __syncthreads();
  const Record<4>* const records = static_cast<const Record<4>*>(lists.records);
  const int64_t end = chunk_end(in, scratch);
  uint32_t all = 0;
  for (int64_t first = chunk_begin(in, scratch); first < end; first += kChunkThreads) {
    const int64_t n = first + threadIdx.x;
    const Footprint footprint = n < end ? load_footprint(in, scratch, n) : Footprint{0, 0};
    for_small_tiles(footprint, in.tile_width, [&](int tile, int) { atomicAdd(tiles + tile, 1u); });
    uint32_t mine = uint32_t(footprint.small_count());
    for_large_owners(footprint, [&](int owner) {
      const int of_large =
          for_large_tiles(footprint, records, n, owner, in.tile_width, [&](int tile, int) { atomicAdd(tiles + tile, 1u); });
      if (int(threadIdx.x & 31) == owner) mine = uint32_t(of_large);
    });
    all = add(all, mine);
  }
  const uint32_t sum = sum_over_block(all, of_warps).all;  // its barrier is also the counts'
  if (threadIdx.x == 0 && scratch.sums != nullptr) scratch.sums[blockIdx.x] = int32_t(sum);
  uint32_t* const row = scratch.chunk_counts + int64_t(blockIdx.x) * count;
  for (int i = threadIdx.x; i < count; i += kChunkThreads) row[i] = tiles[i];
}

// Makes of every chunk's count how many the chunks in front of it have, and sums them up. A lane has one tile, a warp some
// chunks.
__global__ void __launch_bounds__(32 * kPrefixWarps) prefix_chunks(FrameScene in, FrameScratch scratch) {
  __shared__ uint32_t of_warps[kPrefixWarps][32];
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, tiles = int(in.tiles());
  const int tile = int(blockIdx.x) * 32 + lane, each = (scratch.chunks + kPrefixWarps - 1) / kPrefixWarps;
  const int first = warp * each, end = min(first + each, scratch.chunks);
  uint32_t* const column = scratch.chunk_counts + tile;
  uint32_t sum = 0;
  if (tile < tiles)
    for (int chunk = first; chunk < end; chunk += kRowsAtOnce)
#pragma unroll
      for (int k = 0; k < kRowsAtOnce; ++k)
        if (chunk + k < end) sum += column[int64_t(chunk + k) * tiles];
  of_warps[warp][lane] = sum;
  __syncthreads();
  if (tile >= tiles) return;
  uint32_t before = 0;
  for (int w = 0; w < warp; ++w) before += of_warps[w][lane];
  if (warp == kPrefixWarps - 1) scratch.counts[tile] = int32_t(before + sum);
  for (int chunk = first; chunk < end; chunk += kRowsAtOnce) {
    uint32_t values[kRowsAtOnce];
#pragma unroll
    for (int k = 0; k < kRowsAtOnce; ++k) values[k] = chunk + k < end ? column[int64_t(chunk + k) * tiles] : 0;
#pragma unroll
    for (int k = 0; k < kRowsAtOnce; ++k) {
      if (chunk + k < end) column[int64_t(chunk + k) * tiles] = before;
      before += values[k];
    }
  }
}

template <bool training>
__global__ void __launch_bounds__(kChunkThreads) fill_chunks(FrameScene in, FrameLists lists, FrameScratch scratch) {
  extern __shared__ uint32_t cursors[];
  __shared__ uint32_t of_warps[2][32];
  const int count = int(in.tiles());
  let_kernel_behind_come();
  wait_for_kernel_in_front();
  const uint32_t* const row = scratch.chunk_counts + int64_t(blockIdx.x) * count;
  for (int i = threadIdx.x; i < count; i += kChunkThreads) cursors[i] = add(uint32_t(lists.tile_offsets[i]), row[i]);
  __syncthreads();
  const auto reserve = [&](int tile) { return atomicAdd(cursors + tile, 1u); };
  const int64_t end = chunk_end(in, scratch);
  uint32_t in_front = training ? scratch.starts[blockIdx.x] : 0;
  int round = 0;
  for (int64_t first = chunk_begin(in, scratch); first < end; first += kChunkThreads, round ^= 1) {
    const int64_t n = first + threadIdx.x;
    const Footprint footprint = n < end ? load_footprint(in, scratch, n) : Footprint{0, 0};
    const uint32_t depth = footprint.y != 0 ? scratch.depths[n] : 0;
    uint32_t start = 0;
    if constexpr (training) {
      const uint32_t tiles = count_tiles(in, static_cast<const Record<4>*>(lists.records), footprint, n);
      const BlockSum sum = sum_over_block(tiles, of_warps[round]);
      start = add(in_front, sum.before);
      in_front = add(in_front, sum.all);
      if (n < end) store_start(in, lists, n, start, add(start, tiles));
    }
    for_small_tiles(footprint, in.tile_width,
                    [&](int tile, int j) { put_key<training>(lists, reserve(tile), depth, n, start + uint32_t(j)); });
    put_large<training>(in, lists, footprint, n, depth, start, reserve);
  }
}

template <class Kernel>
void allow_shared(Kernel* kernel, size_t bytes) {
  cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, int(bytes));
}

}  // namespace

void count_frame_in_chunks(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const size_t shared = size_t(in.tiles()) * sizeof(uint32_t);
  allow_shared(count_chunks, shared);
  launch_behind(count_chunks, unsigned(scratch.chunks), kChunkThreads, stream, shared, in, lists, scratch);
  launch_behind(prefix_chunks, blocks_for(in.tiles(), 32), 32 * kPrefixWarps, stream, 0, in, scratch);
}

void fill_frame_in_chunks(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  const size_t shared = size_t(in.tiles()) * sizeof(uint32_t);
  const auto kernel = lists.splat_starts != nullptr ? fill_chunks<true> : fill_chunks<false>;
  allow_shared(kernel, shared);
  launch_behind(kernel, unsigned(scratch.chunks), kChunkThreads, stream, shared, in, lists, scratch);
}
