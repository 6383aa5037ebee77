// One block per tile sorts the tile's list by depth, then composites it front to back.
#include <type_traits>

#include "../blending/blend_forward.cuh"
#include "../blending/blend_half.cuh"
#include "dependent_launch.cuh"
#include "frame.h"
#include "tile_sort.cuh"

namespace gsplat::frame {
namespace {

using namespace blending;

using Splat = Record<4>;

// The sorted splats of a tile. After an overflow the list may contain "no instance", which is read as a splat that
// reaches no pixel.
template <Mode mode>
struct TileSplats {
  const Lists& lists;
  SortedIds sorted;
  int64_t count;
  int begin;

  __device__ const Splat* find(int position) const {
    uint32_t number = sorted[position - begin];
    if constexpr (mode == kTraining) number = number < lists.capacity ? uint32_t(lists.instance_splats[number]) : ~0u;
    return number < count ? static_cast<const Splat*>(lists.records) + number : nullptr;
  }
  __device__ Splat operator()(int position) const {
    const Splat* const splat = find(position);
    return splat != nullptr ? *splat : faint_record<4>();
  }
};

// Return the range of a tile's list. If tiles have their own segments, also add the tile's required length to the
// status.
template <Mode mode>
struct TileList {
  int begin, end;

  __device__ TileList(const Lists& lists, const Scratch& scratch, int tile) {
    if constexpr (mode == kSegments) {
      const uint32_t needed = scratch.counters[tile * scratch.counter_stride], capacity = uint32_t(lists.segment);
      begin = tile * lists.segment;
      end = begin + int(min(needed, capacity));
      if (threadIdx.x > 0 || needed == 0) return;
      uint32_t* const status = reinterpret_cast<uint32_t*>(lists.status);
      atomicAdd(status + kStatusNeeded, needed);
      atomicMax(status + kStatusLongest, needed);
      if (needed > capacity) status[kStatusOverflow] = 1;
    } else {
      begin = int(min(int64_t(lists.tile_offsets[tile]), lists.capacity));
      end = int(min(int64_t(lists.tile_offsets[tile + 1]), lists.capacity));
    }
  }
};

template <Mode mode, bool half>
__global__ void __launch_bounds__(kBlockThreads, half ? 6 : 8) blend_tiles(Scene in, Lists lists, Scratch scratch, Pixels out) {
  constexpr bool training = mode == kTraining;
  wait_for_preceding_kernel();
  __shared__ BlendShared<std::conditional_t<half, HalfStage, ForwardStage<4>>> shared;
  const TileList<mode> list(lists, scratch, int(blockIdx.x));
  const int begin = list.begin, end = list.end;
  const SortedIds sorted = sort_tile(lists.keys + begin, end - begin, shared);
  if constexpr (training)
    for (int i = threadIdx.x; i < end - begin; i += kBlockThreads) lists.sorted[begin + i] = int32_t(sorted[i]);

  const int left = int(blockIdx.x) % in.tile_width * kTile, top = int(blockIdx.x) / in.tile_width * kTile;
  const Window w(begin, end, left, top, min(left + kTile, in.width), min(top + kTile, in.height));
  const TileSplats<mode> splats = {lists, sorted, in.count, begin};
  BlendedPixels<4> pixels;
  if constexpr (half)
    pixels = blend_half(w, [&](int position) { return splats.find(position); }, shared.stage);
  else
    pixels = blend_forward<4, false, training>(w, splats, shared.stage);
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

void blend(const Scene& in, const Lists& lists, const Scratch& scratch, const Pixels& out, cudaStream_t stream) {
  if (in.tiles() == 0) return;
  const auto kernel = [&] {
    switch (lists.mode()) {
      case kTraining: return blend_tiles<kTraining, false>;
      case kSegments: return in.half_sh ? blend_tiles<kSegments, true> : blend_tiles<kSegments, false>;
      default: return in.half_sh ? blend_tiles<kShared, true> : blend_tiles<kShared, false>;
    }
  }();
  launch_dependent(kernel, unsigned(in.tiles()), kBlockThreads, stream, 0, in, lists, scratch, out);
}

}  // namespace gsplat::frame
