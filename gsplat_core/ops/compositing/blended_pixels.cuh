// Front-to-back blending of a lane's two pixels.
#pragma once

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

}  // namespace
