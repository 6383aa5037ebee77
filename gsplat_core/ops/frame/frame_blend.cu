#include "../compositing/splat_records.cuh"
#include "frame_cuda.h"
#include "frame_sort.cuh"

namespace {

constexpr int kBatch = kBlockThreads;  // splats that are staged at once, one per thread
using Splat = Record<4>;

// The instances of a block's tile, [begin, end) of the lists. Sorted keys are in shared memory where they fit.
template <bool training>
struct TileList {
  const FrameLists& lists;
  const Splat* records;
  const uint64_t* keys;
  int64_t count;
  int begin, length;

  // A cut list may hold no instance: that is a splat that reaches no pixel.
  __device__ Splat fetch(int at) const {
    if (at >= length) return faint_record<4>();
    uint32_t number = uint32_t(keys[at]);
    if constexpr (training) number = number < lists.capacity ? uint32_t(lists.instance_splats[number]) : ~0u;
    return number < count ? records[number] : faint_record<4>();
  }
};

template <bool training>
__global__ void __launch_bounds__(kBlockThreads) blend(FrameScene in, FrameLists lists, FramePixels out) {
  __shared__ uint64_t shared_keys[kSortKeys];
  __shared__ Splat staged[kBatch];
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  const int64_t begin = min(int64_t(lists.tile_offsets[blockIdx.x]), lists.capacity);
  const int64_t end = min(int64_t(lists.tile_offsets[blockIdx.x + 1]), lists.capacity);
  const int length = int(end - begin);
  const bool fits = length <= kSortKeys;
  if (fits) {
    for (int i = threadIdx.x; i < length; i += kBlockThreads) shared_keys[i] = lists.keys[begin + i];
    __syncthreads();
    sort_shared(shared_keys, length);
  } else {
    sort_long(lists.keys + begin, length, shared_keys);
  }
  const TileList<training> list = {
      lists, static_cast<const Splat*>(lists.records), fits ? shared_keys : lists.keys + begin, in.count, int(begin), length};
  if constexpr (training)
    for (int i = threadIdx.x; i < length; i += kBlockThreads) lists.sorted[begin + i] = int32_t(uint32_t(list.keys[i]));

  const int tile_x = int(blockIdx.x) % in.tile_width * kFrameTile, tile_y = int(blockIdx.x) / in.tile_width * kFrameTile;
  const int first_x = tile_x + warp % 2 * kQuadrant, first_y = tile_y + warp / 2 * kQuadrant;
  const float quadrant_x = float(first_x) + 0.5f, quadrant_y = float(first_y) + 0.5f;
  const int x = first_x + lane % kQuadrant;
  const float center_x = float(x) + 0.5f;
  int y[kPixelsEach], last[kPixelsEach];
  float center_y[kPixelsEach], through[kPixelsEach], sum[kPixelsEach][4];
  bool open[kPixelsEach], inside[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    y[p] = first_y + lane / kQuadrant + p * (kQuadrant / kPixelsEach);
    center_y[p] = float(y[p]) + 0.5f;
    through[p] = 1;
    last[p] = -1;
    open[p] = inside[p] = x < in.width && y[p] < in.height;
    for (int d = 0; d < 4; ++d) sum[p][d] = 0;
  }

  bool warp_open = __any_sync(kAll, open[0] || open[1]);
  Splat next = list.fetch(threadIdx.x);
  for (int first = 0; first < length; first += kBatch) {
    // Also keeps the staged splats until every warp is done with them.
    if (!__syncthreads_or(warp_open)) break;
    staged[threadIdx.x] = next;
    __syncthreads();
    next = list.fetch(first + kBatch + int(threadIdx.x));  // on its way meanwhile
    for (int group = 0; group < kBatch && warp_open; group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(staged[group + lane], quadrant_x, quadrant_y));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        const Splat& r = staged[i];
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          const float power = falloff(r, center_x, center_y[p]).power;
          if (!(open[p] && power >= kFaintest)) continue;
          const float alpha = exp2_fast(fminf(power, kOpaque)), left = fmaf(-alpha, through[p], through[p]);
          if (!(left > kStop)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * through[p];
          for (int d = 0; d < 4; ++d) sum[p][d] = fmaf(weight, r.colors[d], sum[p][d]);
          through[p] = left;
          last[p] = int(begin) + first + i;
        }
      }
      warp_open = __any_sync(kAll, open[0] || open[1]);
    }
  }

  for (int p = 0; p < kPixelsEach; ++p) {
    if (!inside[p]) continue;
    const int64_t pixel = int64_t(y[p]) * in.width + x;
    const float alpha = 1 - through[p];
    out.alphas[pixel] = alpha;
    if (in.background != nullptr)
      for (int d = 0; d < 3; ++d) sum[p][d] = fmaf(through[p], in.background[d], sum[p][d]);
    if constexpr (training) {
      out.last[pixel] = last[p];
    } else {
      sum[p][3] /= fmaxf(alpha, 1e-10f);
    }
    reinterpret_cast<float4*>(out.image)[pixel] = make_float4(sum[p][0], sum[p][1], sum[p][2], sum[p][3]);
  }
}

}  // namespace

void blend_frame(const FrameScene& in, const FrameLists& lists, const FramePixels& out, cudaStream_t stream) {
  if (in.tiles() == 0) return;
  const auto kernel = lists.splat_starts != nullptr ? blend<true> : blend<false>;
  kernel<<<unsigned(in.tiles()), kBlockThreads, 0, stream>>>(in, lists, out);
}
