// Front-to-back blending of one window with one block of kBlockThreads threads.
#pragma once

#include "splats.cuh"

namespace gsplat::blending {
namespace {

// State of a thread's two pixels: the transmittance after the last blended splat, the channel sums, and the position of
// the last blended splat, or -1.
template <int D>
struct BlendedPixels {
  float through[kPixelsEach], sum[kPixelsEach][D];
  int last[kPixelsEach];
};

// Window blended front to back by a block. A pixel is closed once the transmittance after all its splats, including the
// one that closed it, is at most kMinTransmittance.
template <int D, bool kCapped, bool kLast>
struct FloatPixels {
  float front[kPixelsEach];  // transmittance in front of the next splat
  float through[kPixelsEach], sum[kPixelsEach][D];
  uint32_t last[kPixelsEach];  // address of the last blended splat
  AlphaLimit limit;

  __device__ FloatPixels(const Window& w, const AlphaLimit& limit_) : limit(limit_) {
    for (int p = 0; p < kPixelsEach; ++p) {
      front[p] = w.inside[p] ? 1 : 0;
      through[p] = 1;
      for (int d = 0; d < D; ++d) sum[p][d] = 0;
    }
  }
  __device__ bool open() const { return front[0] > kMinTransmittance || front[1] > kMinTransmittance; }
  __device__ void blend(const StagedSplat<D>& r, const float (&power)[kPixelsEach], uint32_t address) {
#pragma unroll
    for (int p = 0; p < kPixelsEach; ++p) {
      const bool drawn = power[p] >= staged_cutoff(limit) && (!kCapped || power[p] <= r.cap);
      const float weight = drawn ? __saturatef(exp2_fast(power[p])) * front[p] : 0;  // in units of 1 / limit.most
      front[p] = fmaf(weight, -limit.most, front[p]);
      if (front[p] > kMinTransmittance) {
        through[p] = front[p];
        for (int d = 0; d < D; ++d) sum[p][d] = fmaf(weight, r.colors[d], sum[p][d]);
        if (kLast && drawn) last[p] = address;
      }
    }
  }
  __device__ void finish(BlendedPixels<D>& out) const {
    for (int p = 0; p < kPixelsEach; ++p) {
      out.through[p] = through[p];
      for (int d = 0; d < D; ++d) out.sum[p][d] = limit.most * sum[p][d];
    }
  }
};

constexpr int kForwardBatch = kBlockThreads;  // splats staged per batch, one per thread
constexpr int kUnrolled = 4;                  // splats that a warp blends between two tests for closed pixels

// Shared memory of a block of the kernel blend_forward; double-buffered.
template <int D>
struct ForwardStage {
  StagedSplat<D> splats[2][kForwardBatch + 1];  // the last entry reaches no pixel
  uint4 reached[2][2 * kWarps];                 // per half quadrant: bits of the batch's splats
  uint4 hits[2 * kWarps][kForwardBatch / 4];    // shared-memory addresses of the splats that reach the half quadrant
};

// List the splats that reach each half of this warp's quadrant. Return the length of the longer list. Both lists are
// padded to that length, rounded up to a multiple of kUnrolled, with a splat that reaches no pixel.
template <int D>
__device__ inline int list_hits(const uint4* reached, const StagedSplat<D>* splats, uint4* hits) {
  const int lane = threadIdx.x & 31;
  const unsigned below = (1u << lane) - 1;
  const uint32_t first = shared_address(splats);
  uint32_t* const lists[2] = {reinterpret_cast<uint32_t*>(hits), reinterpret_cast<uint32_t*>(hits + kForwardBatch / 4)};
  int counts[2] = {};
#pragma unroll
  for (int half = 0; half < 2; ++half) {
    const uint4 bits = reached[2 * half];
    const unsigned groups[4] = {bits.x, bits.y, bits.z, bits.w};
#pragma unroll
    for (int g = 0; g < kForwardBatch / 32; ++g) {
      if (groups[g] >> lane & 1)
        lists[half][counts[half] + __popc(groups[g] & below)] = first + uint32_t((32 * g + lane) * sizeof(StagedSplat<D>));
      counts[half] += __popc(groups[g]);
    }
  }
  const int most = (max(counts[0], counts[1]) + kUnrolled - 1) / kUnrolled * kUnrolled;
#pragma unroll
  for (int half = 0; half < 2; ++half)
    for (int i = counts[half] + lane; i < most; i += 32)
      lists[half][i] = first + uint32_t(kForwardBatch * sizeof(StagedSplat<D>));
  __syncwarp();
  return most;
}

// Blend a window. `fetch(position)` returns the splat at a position in [w.begin, w.end), in depth order. kCapped:
// splats may have a finite `cap` (an indefinite conic). kLast: compute `last`. All threads of the block must call it.
template <int D, bool kCapped, bool kLast = true, class Fetch>
__device__ inline BlendedPixels<D> blend_forward(const Window& w, const Fetch& fetch, ForwardStage<D>& stage,
                                                 const AlphaLimit& limit = {}) {
  constexpr int kBatch = kForwardBatch;
  constexpr uint32_t kNone = ~0u;
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, first_part = warp / 2 * 4 + warp % 2;
  const uint4* const hits = stage.hits[2 * warp + lane / 16];
  const float middle_x = float(w.left + kQuadrant), middle_y = float(w.top + kQuadrant), x = float(w.x) + 0.5f - middle_x;
  FloatPixels<D, kCapped, kLast> pixels(w, limit);
  BlendedPixels<D> out;
  float y[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    y[p] = float(w.y[p]) + 0.5f - middle_y;
    out.last[p] = -1;
  }

  const auto fetch_ahead = [&](int left) {  // Fetch this thread's splat of the batch that begins `left` splats before the end.
    return int(threadIdx.x) < left ? fetch(w.end - left + int(threadIdx.x)) : faint_record<D>();
  };
  if (threadIdx.x < 2) stage.splats[threadIdx.x][kBatch] = staged(faint_record<D>(), middle_x, middle_y, limit);
  Record<D> next = fetch_ahead(w.end - w.begin);
  int now = 0;
  for (int left = w.end - w.begin; left > 0; left -= kBatch, now ^= 1) {
    stage_splat<kQuadrant / 2>(int(threadIdx.x), 32 * warp < left, next, w, stage.splats[now], stage.reached[now], limit);
    bool warp_open = __any_sync(kAll, pixels.open());
    if (!__syncthreads_or(warp_open)) break;
    next = fetch_ahead(left - kBatch);  // prefetched
    const int count = warp_open ? list_hits<D>(&stage.reached[now][first_part], stage.splats[now], stage.hits[2 * warp]) : 0;
    for (uint32_t& last : pixels.last) last = kNone;
    for (int j = 0; j < count && warp_open; j += kUnrolled) {
      const uint4 four = hits[j / 4];
      const uint32_t addresses[kUnrolled] = {four.x, four.y, four.z, four.w};
#pragma unroll
      for (const uint32_t address : addresses) {
        const StagedSplat<D> r = staged_at<D, kCapped>(address);
        const float constant = fmaf(fmaf(r.by_xx, x, r.by_x), x, r.k), by_y = fmaf(r.by_xy, x, r.by_y);
        float power[kPixelsEach];
        for (int p = 0; p < kPixelsEach; ++p) power[p] = fmaf(fmaf(r.by_yy, y[p], by_y), y[p], constant);
        pixels.blend(r, power, address);
      }
      warp_open = __any_sync(kAll, pixels.open());
    }
    for (int p = 0; p < kPixelsEach; ++p)
      if (kLast && pixels.last[p] != kNone)
        out.last[p] = w.end - left + int((pixels.last[p] - shared_address(stage.splats[now])) / sizeof(StagedSplat<D>));
  }
  pixels.finish(out);
  return out;
}

}  // namespace

}  // namespace gsplat::blending
