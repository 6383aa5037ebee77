// Front-to-back blending of a lane's two pixels.
#pragma once

#include <cuda_fp16.h>

#include "staged_splats.cuh"

namespace {

// What shines through behind the last splat, the sums of the channels, and the position of the last splat that was blended, -1
// where there is none.
template <int D>
struct BlendedPixels {
  float through[kPixelsEach], sum[kPixelsEach][D];
  int last[kPixelsEach];
};

// A pixel is closed once the transmittance behind all its splats, the one included that closed it, is at most kStop.
template <int D, bool kCapped, bool kLast>
struct FloatPixels {
  float front[kPixelsEach];  // the transmittance in front of the next splat
  float through[kPixelsEach], sum[kPixelsEach][D];
  uint32_t last[kPixelsEach];  // address of the splat that was blended last

  __device__ explicit FloatPixels(const Window& w) {
    for (int p = 0; p < kPixelsEach; ++p) {
      front[p] = w.inside[p] ? 1 : 0;
      through[p] = 1;
      for (int d = 0; d < D; ++d) sum[p][d] = 0;
    }
  }
  __device__ bool open() const { return front[0] > kStop || front[1] > kStop; }
  __device__ void blend(const StagedSplat<D>& r, const float (&power)[kPixelsEach], uint32_t address) {
#pragma unroll
    for (int p = 0; p < kPixelsEach; ++p) {
      const bool drawn = power[p] >= kFaintestStaged && (!kCapped || power[p] <= r.cap);
      const float weight = drawn ? __saturatef(exp2_fast(power[p])) * front[p] : 0;  // of 1 / 0.99
      front[p] = fmaf(weight, -0.99f, front[p]);
      if (front[p] > kStop) {
        through[p] = front[p];
        for (int d = 0; d < D; ++d) sum[p][d] = fmaf(weight, r.colors[d], sum[p][d]);
        if (kLast && drawn) last[p] = address;
      }
    }
  }
  __device__ void finish(BlendedPixels<D>& out) const {
    for (int p = 0; p < kPixelsEach; ++p) {
      out.through[p] = through[p];
      for (int d = 0; d < D; ++d) out.sum[p][d] = 0.99f * sum[p][d];
    }
  }
};

// The same in half precision, both pixels in one instruction, from the weight on; without `last`. The sums lose about three
// decimals of float32. A splat's colours are pairs of halves.
template <int D>
struct HalfPixels {
  half2 front, weights, sum[D];
  uint32_t last[kPixelsEach];

  __device__ explicit HalfPixels(const Window& w) {
    front = __floats2half2_rn(w.inside[0] ? 1 : 0, w.inside[1] ? 1 : 0);
    weights = __float2half2_rn(0);
    for (int d = 0; d < D; ++d) sum[d] = __float2half2_rn(0);
  }
  __device__ bool open() const { return __low2float(front) > kStop || __high2float(front) > kStop; }
  __device__ void blend(const StagedSplat<D>& r, const float (&power)[kPixelsEach], uint32_t) {
    const half2 alpha = __floats2half2_rn(exp2_fast(power[0]), exp2_fast(power[1]));  // of 1 / 0.99
    const half2 drawn = __hge2(alpha, __float2half2_rn(1 / (0.99f * 255)));
    const half2 weight = __hmul2(__hmul2_sat(alpha, drawn), front);
    front = __hfma2(weight, __float2half2_rn(-0.99f), front);
    const half2 shown = __hmul2(weight, __hgt2(front, __float2half2_rn(kStop)));
    weights = __hadd2(weights, shown);
#pragma unroll
    for (int d = 0; d < D; ++d) sum[d] = __hfma2(shown, pair(r.colors[d]), sum[d]);
  }
  __device__ void finish(BlendedPixels<D>& out) const {
    out.through[0] = fmaf(-0.99f, __low2float(weights), 1.0f);
    out.through[1] = fmaf(-0.99f, __high2float(weights), 1.0f);
    for (int d = 0; d < D; ++d) {
      out.sum[0][d] = 0.99f * __low2float(sum[d]);
      out.sum[1][d] = 0.99f * __high2float(sum[d]);
    }
  }

  __device__ static half2 pair(float bits) { return reinterpret_cast<const half2&>(bits); }
  __device__ static float both(float value) {
    const half2 pair = __float2half2_rn(value);
    return reinterpret_cast<const float&>(pair);
  }
};

}  // namespace
