#include "../compositing/blend_forward.cuh"
#include "frame_cuda.h"
#include "frame_sort.cuh"

namespace {

using Splat = Record<4>;

// The instances of a block's tile by depth, from position `begin` of the lists.
template <bool training>
struct TileList {
  const FrameLists& lists;
  const Splat* records;
  const uint64_t* keys;  // of `begin` and on: in shared memory where they fit
  int64_t count;
  int begin;

  // A cut list may hold no instance: that is a splat that reaches no pixel.
  __device__ Splat operator()(int position) const {
    uint32_t number = uint32_t(keys[position - begin]);
    if constexpr (training) number = number < lists.capacity ? uint32_t(lists.instance_splats[number]) : ~0u;
    return number < count ? records[number] : faint_record<4>();
  }
};

template <bool training>
__global__ void __launch_bounds__(kBlockThreads) blend(FrameScene in, FrameLists lists, FramePixels out) {
  __shared__ uint64_t shared_keys[kSortKeys];
  __shared__ ForwardStage<4> stage;
  const int begin = int(min(int64_t(lists.tile_offsets[blockIdx.x]), lists.capacity));
  const int end = int(min(int64_t(lists.tile_offsets[blockIdx.x + 1]), lists.capacity));
  const int length = end - begin;
  const bool fits = length <= kSortKeys;
  if (fits) {
    for (int i = threadIdx.x; i < length; i += kBlockThreads) shared_keys[i] = lists.keys[begin + i];
    __syncthreads();
    sort_shared(shared_keys, length);
  } else {
    sort_long(lists.keys + begin, length, shared_keys);
  }
  const TileList<training> fetch = {lists, static_cast<const Splat*>(lists.records), fits ? shared_keys : lists.keys + begin,
                                    in.count, begin};
  if constexpr (training)
    for (int i = threadIdx.x; i < length; i += kBlockThreads) lists.sorted[begin + i] = int32_t(uint32_t(fetch.keys[i]));

  const int left = int(blockIdx.x) % in.tile_width * kFrameTile, top = int(blockIdx.x) / in.tile_width * kFrameTile;
  const Window w(begin, end, left, top, min(left + kFrameTile, in.width), min(top + kFrameTile, in.height));
  BlendedPixels<4> pixels = blend_forward<4, false>(w, fetch, stage);
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
  const auto kernel = lists.splat_starts != nullptr ? blend<true> : blend<false>;
  kernel<<<unsigned(in.tiles()), kBlockThreads, 0, stream>>>(in, lists, out);
}
