#include <type_traits>

#include "../compositing/blend_forward.cuh"
#include "../compositing/blend_half.cuh"
#include "frame_cuda.h"
#include "frame_launch.cuh"
#include "frame_tile_sort.cuh"

namespace {

using Splat = Record<4>;

// The splats of a tile for blending. A cut list may hold no instance: that is a splat that reaches no pixel.
template <ListKind kind>
struct TileSplats {
  const FrameLists& lists;
  SortedNumbers sorted;
  int64_t count;
  int begin;

  __device__ const Splat* find(int position) const {
    uint32_t number = sorted[position - begin];
    if constexpr (kind == kTraining) number = number < lists.capacity ? uint32_t(lists.instance_splats[number]) : ~0u;
    return number < count ? static_cast<const Splat*>(lists.records) + number : nullptr;
  }
  __device__ Splat operator()(int position) const {
    const Splat* const splat = find(position);
    return splat != nullptr ? *splat : faint_record<4>();
  }
};

// A tile's list. One with a room of its own is also where the tile reports how much it needed.
template <ListKind kind>
struct TileList {
  int begin, end;

  __device__ TileList(const FrameLists& lists, const FrameScratch& scratch, int tile) {
    if constexpr (kind == kPerTile) {
      const uint32_t needed = scratch.slots[tile * scratch.slot_stride], room = uint32_t(lists.tile_capacity);
      begin = tile * lists.tile_capacity;
      end = begin + int(min(needed, room));
      if (threadIdx.x > 0 || needed == 0) return;
      uint32_t* const status = reinterpret_cast<uint32_t*>(lists.status);
      atomicAdd(status + kStatusNeeded, needed);
      atomicMax(status + kStatusMost, needed);
      if (needed > room) status[kStatusCut] = 1;
    } else {
      begin = int(min(int64_t(lists.tile_offsets[tile]), lists.capacity));
      end = int(min(int64_t(lists.tile_offsets[tile + 1]), lists.capacity));
    }
  }
};

template <ListKind kind, bool half>
__global__ void __launch_bounds__(kBlockThreads, half ? 6 : 8)
    blend(FrameScene in, FrameLists lists, FrameScratch scratch, FramePixels out) {
  constexpr bool training = kind == kTraining;
  wait_for_kernel_in_front();
  __shared__ BlendRoom<std::conditional_t<half, HalfStage, ForwardStage<4>>> room;
  const TileList<kind> list(lists, scratch, int(blockIdx.x));
  const int begin = list.begin, end = list.end;
  const SortedNumbers sorted = sort_tile(lists.keys + begin, end - begin, room);
  if constexpr (training)
    for (int i = threadIdx.x; i < end - begin; i += kBlockThreads) lists.sorted[begin + i] = int32_t(sorted[i]);

  const int left = int(blockIdx.x) % in.tile_width * kFrameTile, top = int(blockIdx.x) / in.tile_width * kFrameTile;
  const Window w(begin, end, left, top, min(left + kFrameTile, in.width), min(top + kFrameTile, in.height));
  const TileSplats<kind> splats = {lists, sorted, in.count, begin};
  BlendedPixels<4> pixels;
  if constexpr (half)
    pixels = blend_half(w, [&](int position) { return splats.find(position); }, room.stage);
  else
    pixels = blend_forward<4, false, training>(w, splats, room.stage);
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

void blend_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, const FramePixels& out,
                 cudaStream_t stream) {
  if (in.tiles() == 0) return;
  const auto kernel = [&] {
    switch (lists.kind()) {
      case kTraining: return blend<kTraining, false>;
      case kPerTile: return in.half_sh ? blend<kPerTile, true> : blend<kPerTile, false>;
      default: return in.half_sh ? blend<kShared, true> : blend<kShared, false>;
    }
  }();
  launch_behind(kernel, unsigned(in.tiles()), kBlockThreads, stream, 0, in, lists, scratch, out);
}
