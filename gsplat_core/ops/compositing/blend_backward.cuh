// Back-to-front gradient of blending one window, by one block of kBlockThreads threads, by the formulas of backward_cpu.cpp.
#pragma once

#include "blend_window.cuh"

namespace {

constexpr int kShapeMoments = 6;    // sum over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha
constexpr int kBackwardBatch = 64;  // splats that are staged at once
constexpr int kValues = 16;         // that a warp sums at once

// A row: the moments, |dL/dx| and |dL/dy| (with absgrad, or for any number of channels), colours; in whole float4s.
constexpr int shape_size(int D, bool absgrad) { return kShapeMoments + (D == 0 || absgrad ? 2 : 0); }
constexpr int quads_of(int shape, int channels) { return (shape + channels + 3) / 4; }

// Sums 2 kHalf values over groups of 4 kHalf lanes with one exchange per value: a lane gives half of its values away, then half
// of the rest. For 16 values lane i of the warp returns the sum of value i / 2.
template <int kHalf>
__device__ inline float warp_sums(float* v, int lane) {
  if constexpr (kHalf == 0) {
    return v[0] + __shfl_xor_sync(kAll, v[0], 1);
  } else {
    const bool upper = (lane & 2 * kHalf) != 0;
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float low = v[i], high = v[i + kHalf];
      v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, 2 * kHalf);
    }
    return warp_sums<kHalf / 2>(v, lane);
  }
}

// A pixel on the way from the back to the front.
struct Pixel {
  float through;  // transmittance in front of the splats seen so far; at first what the pixel lets through in the end
  float behind;   // sum of w g of what is behind, g = <dL/dcolour, colour>; at first -through dL/dalpha, and the background's
  int last;       // position of the last splat that was blended, -1 where there is none
};

// What a splat's gradient needs of a pixel.
struct Blend {
  float alpha, through, widen, weight;
};
__device__ inline Blend blend(const Pixel& pixel, float power) {
  Blend b;
  b.alpha = exp2_fast(fminf(power, kOpaque));
  b.widen = reciprocal(1 - b.alpha);
  b.through = pixel.through * b.widen;
  b.weight = b.alpha * b.through;
  return b;
}

// Adds a pixel's part of the moments and moves the pixel in front of the splat.
template <bool kAbs, int D>
__device__ inline void add_moments(const Record<D>& r, const Falloff& f, const Blend& b, float g, Pixel& pixel, float* v) {
  const float v_alpha = fmaf(b.through, g, -(pixel.behind * b.widen));
  pixel.through = b.through;
  pixel.behind = fmaf(b.weight, g, pixel.behind);
  // A splat at the ceiling of 0.99 passes nothing on to its opacity and shape.
  const float s = f.power <= kOpaque ? b.alpha * v_alpha : 0, sx = s * f.dx, sy = s * f.dy;
  v[0] += s;
  v[1] += sx;
  v[2] += sy;
  v[3] = fmaf(sx, f.dx, v[3]);
  v[4] = fmaf(sx, f.dy, v[4]);
  v[5] = fmaf(sy, f.dy, v[5]);
  if constexpr (kAbs) {
    v[kShapeMoments] += fabsf(-kLn2 * fmaf(2 * r.xyab.z, sx, r.xyab.w * sy));
    v[kShapeMoments + 1] += fabsf(-kLn2 * fmaf(r.xyab.w, sx, 2 * r.c * sy));
  }
}

__device__ inline int block_furthest(int warp_furthest) {
  __shared__ int most[kWarps];
  if ((threadIdx.x & 31) == 0) most[threadIdx.x / 32] = warp_furthest;
  __syncthreads();
  int furthest = -1;
  for (int i = 0; i < kWarps; ++i) furthest = max(furthest, most[i]);
  return furthest;
}

// Shared memory that blend_backward works in.
template <int D, bool kAbs>
struct BackwardStage {
  static constexpr int kQuads = quads_of(shape_size(D, kAbs), D);
  Record<D> splats[kBackwardBatch];
  float4 sums[kWarps][kBackwardBatch][kQuads];
  unsigned touched[kWarps][kBackwardBatch / 32];
};

// `fetch(position)` gives the splat at a position in [w.begin, w.end), `row(position)` where its row goes: the sums over the
// window's pixels, in quads_of(shape_size(D, kAbs), D) float4s. Every row of the window is written, in a fixed order of
// additions. `v_color` is dL/dcolour of the thread's pixels, 0 outside of the image.
template <int D, bool kAbs, bool kCapped, class Fetch, class Row>
__device__ inline void blend_backward(const Window& w, const Fetch& fetch, Pixel (&pixels)[kPixelsEach],
                                      const float (&v_color)[kPixelsEach][D], const Row& row, BackwardStage<D, kAbs>& stage) {
  constexpr int kBatch = kBackwardBatch, kShape = shape_size(D, kAbs), kQuads = BackwardStage<D, kAbs>::kQuads;
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  const int warp_furthest = __reduce_max_sync(kAll, max(pixels[0].last, pixels[1].last));
  const int furthest = block_furthest(warp_furthest);
  const int end = furthest < w.begin ? w.begin : min(furthest + 1, w.end);
  for (int64_t e = threadIdx.x; e < int64_t(w.end - end) * kQuads; e += kBlockThreads)
    row(end + int(e / kQuads))[e % kQuads] = make_float4(0, 0, 0, 0);
  if (end == w.begin) return;

  const float center_x = float(w.x) + 0.5f, quadrant_x = float(w.quadrant_x) + 0.5f, quadrant_y = float(w.quadrant_y) + 0.5f;
  float center_y[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) center_y[p] = float(w.y[p]) + 0.5f;
  const auto fetch_ahead = [&](int first) {
    const int position = first + int(threadIdx.x);
    return threadIdx.x < kBatch && position >= w.begin && position < end ? fetch(position) : faint_record<D>();
  };
  int first = w.begin + (end - 1 - w.begin) / kBatch * kBatch;
  Record<D> next = fetch_ahead(first);
  for (; first >= w.begin; first -= kBatch) {
    if (threadIdx.x < kBatch) stage.splats[threadIdx.x] = next;
    __syncthreads();
    next = fetch_ahead(first - kBatch);  // on its way meanwhile
    for (int group = kBatch - 32; group >= 0; group -= 32) {
      const bool needed = first + group + lane <= warp_furthest && reaches(stage.splats[group + lane], quadrant_x, quadrant_y);
      unsigned hits = __ballot_sync(kAll, needed), used = 0;
      while (hits != 0) {
        const int bit = 31 - __clz(int(hits)), i = group + bit;
        hits ^= 1u << bit;
        const Record<D>& r = stage.splats[i];
        Falloff f[kPixelsEach];
        bool valid[kPixelsEach], any = false;
        for (int p = 0; p < kPixelsEach; ++p) {
          f[p] = falloff(r, center_x, center_y[p]);
          valid[p] = f[p].power >= kFaintest && (!kCapped || f[p].power <= r.cap) && first + i <= pixels[p].last;
          any |= valid[p];
        }
        if (!__any_sync(kAll, any)) continue;
        float v[kValues] = {};
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          if (!valid[p]) continue;
          const Blend b = blend(pixels[p], f[p].power);
          float g = 0;
          for (int d = 0; d < D; ++d) {
            g = fmaf(v_color[p][d], r.colors[d], g);
            v[kShape + d] = fmaf(b.weight, v_color[p][d], v[kShape + d]);
          }
          add_moments<kAbs>(r, f[p], b, g, pixels[p], v);
        }
        const float sum = warp_sums<kValues / 2>(v, lane);
        if ((lane & 1) == 0 && lane / 2 < 4 * kQuads) reinterpret_cast<float*>(stage.sums[warp][i])[lane / 2] = sum;
        used |= 1u << bit;
      }
      if (lane == 0) stage.touched[warp][group / 32] = used;
    }
    __syncthreads();
    const int count = min(end - first, kBatch);
    for (int e = threadIdx.x; e < count * kQuads; e += kBlockThreads) {
      const int i = e / kQuads, q = e % kQuads;
      float4 sum = make_float4(0, 0, 0, 0);
      for (int from = 0; from < kWarps; ++from) {
        if ((stage.touched[from][i / 32] >> (i % 32) & 1) == 0) continue;
        const float4 part = stage.sums[from][i][q];
        sum = make_float4(sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w);
      }
      row(first + i)[q] = sum;
    }
  }
}

}  // namespace
