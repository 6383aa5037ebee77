// Back-to-front gradient of blending one window with one block of kBlockThreads threads. The formulas are derived in
// ../compositing/backward_cpu.cpp.
#pragma once

#include "pixel_sums.cuh"

namespace gsplat::blending {
namespace {

constexpr int kShapeMoments = 6;    // sum over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha
constexpr int kBackwardBatch = 64;  // splats staged per batch

// Number of values of a gradient row without the colours: the moments, then |dL/dx| and |dL/dy| (with absgrad, or if
// the number of channels is not compiled in). Rows are padded to whole float4s.
constexpr int shape_size(int D, bool absgrad) { return kShapeMoments + (D == 0 || absgrad ? 2 : 0); }
constexpr int quads_of(int shape, int channels) { return (shape + channels + 3) / 4; }

// State of a pixel during the back-to-front traversal.
struct Pixel {
  float through;  // transmittance in front of the splats visited so far; initially the pixel's final transmittance
  // Sum of w g of the splats behind, with g = <dL/dcolour, colour>. Initially -through dL/dalpha plus the background's
  // term.
  float behind;
  int last;  // position of the last blended splat, or -1
};

__device__ inline int block_furthest(int warp_furthest) {
  __shared__ int most[kWarps];
  if ((threadIdx.x & 31) == 0) most[threadIdx.x / 32] = warp_furthest;
  __syncthreads();
  int furthest = -1;
  for (int i = 0; i < kWarps; ++i) furthest = max(furthest, most[i]);
  return furthest;
}

// Shared memory of a block of the kernel blend_backward.
template <int D, bool kAbs>
struct BackwardStage {
  static constexpr int kQuads = quads_of(shape_size(D, kAbs), D);
  static constexpr int kSums = (shape_size(D, kAbs) + D + 1) / 2 * 2;
  StagedSplat<D> splats[kBackwardBatch + 1];  // the last entry reaches no pixel
  uint4 reached[kWarps];                      // bits of the batch's splats that reach each quadrant
  SplatTerms terms[kWarps];
  float sums[kWarps][kBackwardBatch][kSums];  // per quadrant, relative to its centre: moments, |.| with absgrad, colours
  alignas(16) uint32_t hits[kWarps][kBackwardBatch + kSlots];  // byte offsets of the splats that reach the warp's quadrant
};

// Write the byte offsets of the splats of the batch that reach this warp's pixels to `hits`, back to front, and return
// their number. kSlots further entries refer to a splat that reaches no pixel.
template <int D>
__device__ inline int list_hits_backward(unsigned (&groups)[kBackwardBatch / 32], uint32_t* hits) {
  const int lane = threadIdx.x & 31;
  const unsigned behind = ~1u << lane;
  int count = 0;
#pragma unroll
  for (int g = kBackwardBatch / 32 - 1; g >= 0; --g) {
    if (groups[g] >> lane & 1) hits[count + __popc(groups[g] & behind)] = uint32_t((32 * g + lane) * sizeof(StagedSplat<D>));
    count += __popc(groups[g]);
  }
  if (lane < kSlots) hits[count + lane] = uint32_t(kBackwardBatch * sizeof(StagedSplat<D>));
  __syncwarp();
  return count;
}

// Terms of a splat's gradient at one pixel. Computing them moves the pixel's state in front of the splat.
struct Terms {
  float s, w;  // both in units of 1 / AlphaLimit::most
};
struct PixelState {
  float through;  // transmittance in front of the splats visited so far
  float behind;   // <dL/dcolour, colour behind the splats in front>
};
template <int D>
__device__ inline Terms terms_of(const StagedSplat<D>& r, float power, bool drawn, const float (&v_color)[D],
                                 const AlphaLimit& limit, PixelState& pixel) {
  const float alpha = drawn ? __saturatef(exp2_fast(power)) : 0;  // in units of 1 / limit.most
  const float lets_through = fmaf(alpha, -limit.most, 1.0f);
  float g = v_color[0] * r.colors[0];
#pragma unroll
  for (int d = 1; d < D; ++d) g = fmaf(v_color[d], r.colors[d], g);
  pixel.through *= reciprocal(lets_through);
  const float w = alpha * pixel.through, gain = g - pixel.behind;
  pixel.behind = fmaf(-lets_through, gain, g);
  // Where alpha is clamped to its maximum, opacity and shape have no gradient.
  return {power <= 0 ? w * gain : 0, w};
}

// Add up the quadrants' sums of one of the batch's splats and write them as its row, relative to the splat's mean (x,
// y).
template <int D, bool kAbs, class Row>
__device__ inline void write_row(const BackwardStage<D, kAbs>& stage, const Window& w, int i, float x, float y, float most,
                                 const Row& row) {
  constexpr int kShape = shape_size(D, kAbs), kQuads = BackwardStage<D, kAbs>::kQuads;
  float v[4 * kQuads] = {};
#pragma unroll
  for (int q = 0; q < kWarps; ++q) {
    if ((reinterpret_cast<const unsigned*>(&stage.reached[q])[i / 32] >> (i % 32) & 1) == 0) continue;
    const float* const sums = stage.sums[q][i];
    const float dx = float(w.left + q % 2 * kQuadrant + kQuadrant / 2) - x;
    const float dy = float(w.top + q / 2 * kQuadrant + kQuadrant / 2) - y;
    const float s = sums[0], sx = fmaf(dx, s, sums[1]), sy = fmaf(dy, s, sums[2]);
    v[0] += s;
    v[1] += sx;
    v[2] += sy;
    v[3] += fmaf(dx, sx + sums[1], sums[3]);
    v[4] += fmaf(dx, sy, fmaf(dy, sums[1], sums[4]));
    v[5] += fmaf(dy, sy + sums[2], sums[5]);
#pragma unroll
    for (int d = kShapeMoments; d < kShape + D; ++d) v[d] += sums[d];
  }
#pragma unroll
  for (int quad = 0; quad < kQuads; ++quad)
    row[quad] = make_float4(most * v[4 * quad], most * v[4 * quad + 1], most * v[4 * quad + 2], most * v[4 * quad + 3]);
}

// Compute the gradient rows of a window's splats. `fetch(position)` returns the splat at a position in [w.begin,
// w.end); `row(position)` returns the destination of its row of quads_of(shape_size(D, kAbs), D) float4s. Every row of
// the window is written, with a fixed order of additions. `v_color` is dL/dcolour of the thread's pixels, 0 outside of
// the image. `summed` are the values whose weighted sums become the row's colours; for gradients it equals `v_color`.
template <int D, bool kAbs, bool kCapped, class Fetch, class Row>
__device__ inline void blend_backward(const Window& w, const Fetch& fetch, const Pixel (&pixels)[kPixelsEach],
                                      const float (&v_color)[kPixelsEach][D], const float (&summed)[kPixelsEach][D],
                                      const Row& row, BackwardStage<D, kAbs>& stage, const AlphaLimit& limit = {}) {
  constexpr int kBatch = kBackwardBatch, kShape = shape_size(D, kAbs), kQuads = BackwardStage<D, kAbs>::kQuads;
  constexpr int kUnrolled = 4;
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  const int warp_furthest = __reduce_max_sync(kAll, max(pixels[0].last, pixels[1].last));
  const int furthest = block_furthest(warp_furthest);
  const int end = furthest < w.begin ? w.begin : min(furthest + 1, w.end);
  for (int64_t e = threadIdx.x; e < int64_t(w.end - end) * kQuads; e += kBlockThreads)
    row(end + int(e / kQuads))[e % kQuads] = make_float4(0, 0, 0, 0);
  if (end == w.begin) return;

  const float middle_x = float(w.left + kQuadrant), middle_y = float(w.top + kQuadrant), x = float(w.x) + 0.5f - middle_x;
  const uint32_t first_address = shared_address(stage.splats);
  const PixelFactors<D> factors(summed, stage.terms[warp]);
  float y[kPixelsEach];
  PixelState states[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    y[p] = float(w.y[p]) + 0.5f - middle_y;
    states[p] = {pixels[p].through, pixels[p].behind / pixels[p].through};
  }
  // Index of the splat in the batch that this thread stages and whose row it writes. A batch has fewer splats than the
  // block has threads. Blocks alternate the warps that stage, to balance the multiprocessor's four schedulers.
  const int mine = int(threadIdx.x) ^ (__popc(blockIdx.x) % 2 * kBatch);
  const auto fetch_ahead = [&](int first) {
    const int position = first + mine;
    return mine < kBatch && position >= w.begin && position < end ? fetch(position) : faint_record<D>();
  };
  if (threadIdx.x == kBlockThreads - 1) stage.splats[kBatch] = staged(faint_record<D>(), middle_x, middle_y, limit);
  int first = w.begin + (end - 1 - w.begin) / kBatch * kBatch;
  Record<D> next = fetch_ahead(first);
  for (; first >= w.begin; first -= kBatch) {
    __syncwarp();  // wait until all lanes have read the data that is overwritten next
    const float mean_x = next.xyab.x, mean_y = next.xyab.y;
    if (mine < kBatch) stage_splat<kQuadrant>(mine, first + mine / 32 * 32 < end, next, w, stage.splats, stage.reached, limit);
    __syncthreads();
    next = fetch_ahead(first - kBatch);  // prefetched
    unsigned groups[kBatch / 32];
    uint32_t limits[kPixelsEach];  // no pixel blended a splat at these offsets or later
#pragma unroll
    for (int g = 0; g < kBatch / 32; ++g) {
      const int most = warp_furthest - first - 32 * g;  // last splat of the group that any of the warp's pixels blended
      groups[g] = reinterpret_cast<const unsigned*>(&stage.reached[warp])[g] & (most < 0     ? 0
                                                                                : most >= 31 ? ~0u
                                                                                             : (2u << most) - 1);
    }
    __syncwarp();
    if (lane == 0)
      for (int g = 0; g < kBatch / 32; ++g) reinterpret_cast<unsigned*>(&stage.reached[warp])[g] = groups[g];
    for (int p = 0; p < kPixelsEach; ++p)
      limits[p] = uint32_t(max(0, min(pixels[p].last - first + 1, kBatch)) * int(sizeof(StagedSplat<D>)));
    const int count = list_hits_backward<D>(groups, stage.hits[warp]);
    for (int begin = 0; begin < count; begin += kSlots) {
#pragma unroll 1
      for (int slot = 0; slot < kSlots && begin + slot < count; slot += kUnrolled) {
        uint32_t offset[kUnrolled];
#pragma unroll
        for (int n = 0; n < kUnrolled; ++n) offset[n] = stage.hits[warp][begin + slot + n];
#pragma unroll
        for (int n = 0; n < kUnrolled; ++n) {
          const StagedSplat<D> r = staged_at<D, kCapped>(first_address + offset[n]);
          const float constant = fmaf(fmaf(r.by_xx, x, r.by_x), x, r.k), by_y = fmaf(r.by_xy, x, r.by_y);
          Terms terms[kPixelsEach];
          float absolute[2] = {};
#pragma unroll
          for (int p = 0; p < kPixelsEach; ++p) {
            const float power = fmaf(fmaf(r.by_yy, y[p], by_y), y[p], constant);
            const bool drawn = power >= staged_cutoff(limit) && offset[n] < limits[p] && (!kCapped || power <= r.cap);
            terms[p] = terms_of<D>(r, power, drawn, v_color[p], limit, states[p]);
            if constexpr (kAbs) {
              const float s = kLn2 * fabsf(terms[p].s);
              absolute[0] = fmaf(s, fabsf(fmaf(2 * r.by_xx, x, fmaf(r.by_xy, y[p], r.by_x))), absolute[0]);
              absolute[1] = fmaf(s, fabsf(fmaf(2 * r.by_yy, y[p], by_y)), absolute[1]);
            }
          }
          stage.terms[warp][slot + n][lane] = make_float4(terms[0].s, terms[1].s, terms[0].w, terms[1].w);
          if constexpr (kAbs) {
            for (int mask = 16; mask > 0; mask /= 2)
              for (float& a : absolute) a += __shfl_xor_sync(kAll, a, mask);
            if (lane < 2 && begin + slot + n < count)
              stage.sums[warp][offset[n] / sizeof(StagedSplat<D>)][kShapeMoments + lane] = absolute[lane];
          }
        }
      }
      __syncwarp();
      float moments[2], colors[PixelFactors<D>::kColorTiles];
      sum_terms<D>(stage.terms[warp], factors, moments, colors);
      const int slot = lane / 4, column = lane % 4;
      if (begin + slot < count) {
        float* const sums = stage.sums[warp][stage.hits[warp][begin + slot] / sizeof(StagedSplat<D>)];
        if (column < 3) *reinterpret_cast<float2*>(sums + 2 * column) = make_float2(moments[0], moments[1]);
#pragma unroll
        for (int tile = 0; tile < PixelFactors<D>::kColorTiles; ++tile)
          if (4 * tile + column < D) sums[kShape + 4 * tile + column] = colors[tile];
      }
      __syncwarp();
    }
    __syncthreads();
    if (mine < kBatch && first + mine < end) write_row(stage, w, mine, mean_x, mean_y, limit.most, row(first + mine));
  }
}

}  // namespace

}  // namespace gsplat::blending
