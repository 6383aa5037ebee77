#include "../compositing/blend_forward.cuh"
#include "frame_cuda.h"
#include "frame_launch.cuh"
#include "frame_sort.cuh"

namespace {

using Splat = Record<4>;

// A block's shared memory: for sorting, then for the sorted numbers and for blending.
union BlendRoom {
  uint64_t keys[kSortKeys];
  struct {
    uint32_t numbers[kBlockThreads * kMostInThread];
    ForwardStage<4> stage;
  };
};

// The low words of a tile's keys by depth: splats, or instances when training. In shared memory where they fit.
struct SortedNumbers {
  const uint32_t* first;
  int stride;
  __device__ uint32_t operator[](int i) const { return first[i * stride]; }
};

template <int kEach>
__device__ inline void sort_short(const uint64_t* keys, int length, BlendRoom& room) {
  uint64_t mine[kEach];
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    const int at = i * kBlockThreads + int(threadIdx.x);
    mine[i] = at < length ? keys[at] : ~0ull;
  }
  sort_in_registers<kEach>(mine, length, room.keys);
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kEach; ++i) room.numbers[int(threadIdx.x) * kEach + i] = uint32_t(mine[i]);
}

// Ends with a barrier.
__device__ inline SortedNumbers sort_tile(uint64_t* keys, int length, BlendRoom& room) {
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

// The splats of a tile for blending. A cut list may hold no instance: that is a splat that reaches no pixel.
template <bool training>
struct TileSplats {
  const FrameLists& lists;
  SortedNumbers sorted;
  int64_t count;
  int begin;

  __device__ Splat operator()(int position) const {
    uint32_t number = sorted[position - begin];
    if constexpr (training) number = number < lists.capacity ? uint32_t(lists.instance_splats[number]) : ~0u;
    return number < count ? static_cast<const Splat*>(lists.records)[number] : faint_record<4>();
  }
};

template <bool training, bool half>
__global__ void __launch_bounds__(kBlockThreads, 8) blend(FrameScene in, FrameLists lists, FramePixels out) {
  wait_for_kernel_in_front();
  __shared__ BlendRoom room;
  const int begin = int(min(int64_t(lists.tile_offsets[blockIdx.x]), lists.capacity));
  const int end = int(min(int64_t(lists.tile_offsets[blockIdx.x + 1]), lists.capacity));
  const SortedNumbers sorted = sort_tile(lists.keys + begin, end - begin, room);
  if constexpr (training)
    for (int i = threadIdx.x; i < end - begin; i += kBlockThreads) lists.sorted[begin + i] = int32_t(sorted[i]);

  const int left = int(blockIdx.x) % in.tile_width * kFrameTile, top = int(blockIdx.x) / in.tile_width * kFrameTile;
  const Window w(begin, end, left, top, min(left + kFrameTile, in.width), min(top + kFrameTile, in.height));
  BlendedPixels<4> pixels =
      blend_forward<4, false, training, half>(w, TileSplats<training>{lists, sorted, in.count, begin}, room.stage);
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = int64_t(w.y[p]) * in.width + w.x;
    const float through = pixels.through[p], alpha = 1 - through;
    float* const sum = pixels.sum[p];
    if (in.background != nullptr)
      for (int d = 0; d < 3; ++d) sum[d] = fmaf(through, in.background[d], sum[d]);
    if constexpr (training) {
      out.last[pixel] = pixels.last[p];
    } else {
      sum[3] /= fmaxf(alpha, 1e-10f);
    }
    out.alphas[pixel] = alpha;
    reinterpret_cast<float4*>(out.image)[pixel] = make_float4(sum[0], sum[1], sum[2], sum[3]);
  }
}

}  // namespace

void blend_frame(const FrameScene& in, const FrameLists& lists, const FramePixels& out, cudaStream_t stream) {
  if (in.tiles() == 0) return;
  const auto kernel = lists.splat_starts != nullptr ? blend<true, false> : in.half_sh ? blend<false, true> : blend<false, false>;
  launch_behind(kernel, unsigned(in.tiles()), kBlockThreads, stream, 0, in, lists, out);
}
