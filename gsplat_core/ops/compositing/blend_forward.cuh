// Front-to-back blending of one window by one block of kBlockThreads threads.
#pragma once

#include "blend_window.cuh"

namespace {

// Shared memory that blend_forward works in.
template <int D>
struct ForwardStage {
  Record<D> splats[kBlockThreads];
};

// A thread's pixels: what shines through behind the last splat, the sums of the channels, and the position of the last splat
// that was blended, -1 where there is none.
template <int D>
struct BlendedPixels {
  float through[kPixelsEach], sum[kPixelsEach][D];
  int last[kPixelsEach];
};

// `fetch(position)` gives the splat at a position in [w.begin, w.end), which are in the order of depth. kCapped: there may be
// splats with a finite `cap` (an indefinite conic). All threads of the block take part.
template <int D, bool kCapped, class Fetch>
__device__ inline BlendedPixels<D> blend_forward(const Window& w, const Fetch& fetch, ForwardStage<D>& stage) {
  constexpr int kBatch = kBlockThreads;  // splats that are staged at once, one per thread
  const int lane = threadIdx.x & 31;
  const float center_x = float(w.x) + 0.5f, quadrant_x = float(w.quadrant_x) + 0.5f, quadrant_y = float(w.quadrant_y) + 0.5f;
  BlendedPixels<D> out;
  float center_y[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    center_y[p] = float(w.y[p]) + 0.5f;
    out.through[p] = 1;
    out.last[p] = -1;
    open[p] = w.inside[p];
    for (int d = 0; d < D; ++d) out.sum[p][d] = 0;
  }

  const auto fetch_ahead = [&](int left) {  // the splat of this thread in the batch that has `left` more and what follows it
    return int(threadIdx.x) < left ? fetch(w.end - left + int(threadIdx.x)) : faint_record<D>();
  };
  bool warp_open = __any_sync(kAll, open[0] || open[1]);
  Record<D> next = fetch_ahead(w.end - w.begin);
  for (int left = w.end - w.begin; left > 0; left -= kBatch) {
    // Also keeps the staged splats until every warp is done with them.
    if (!__syncthreads_or(warp_open)) break;
    stage.splats[threadIdx.x] = next;
    __syncthreads();
    next = fetch_ahead(left - kBatch);  // on its way meanwhile
    for (int group = 0; group < kBatch && warp_open; group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(stage.splats[group + lane], quadrant_x, quadrant_y));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        const Record<D>& r = stage.splats[i];
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          const float power = falloff(r, center_x, center_y[p]).power;
          if (!(open[p] && power >= kFaintest && (!kCapped || power <= r.cap))) continue;
          const float alpha = exp2_fast(fminf(power, kOpaque)), through = fmaf(-alpha, out.through[p], out.through[p]);
          if (!(through > kStop)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * out.through[p];
          for (int d = 0; d < D; ++d) out.sum[p][d] = fmaf(weight, r.colors[d], out.sum[p][d]);
          out.through[p] = through;
          out.last[p] = w.end - left + i;
        }
      }
      warp_open = __any_sync(kAll, open[0] || open[1]);
    }
  }
  return out;
}

}  // namespace
