// Per-warp processing of one Gaussian. 32 bumps, one per lane, are tested for activity; then two consecutive rows of 13
// channels are processed at a time, one per half warp. Active bumps are nearly always consecutive, so the loop covers
// all rows from the first active bump to the last; inactive rows in between are not read.
#pragma once

#include "basis_field.h"

namespace gsplat::basis_field {

constexpr unsigned kAll = ~0u;
constexpr int kBlock = 256;  // threads
constexpr int kWarps = kBlock / 32;
constexpr float kLog2e = 1.44269504f;

struct Bump {
  float u, inverse_width, height;  // height is exp(-u^2), zero where inactive
  bool active;
};

// 2^x to 2 ulp, for x from -126 to 126.
__device__ __forceinline__ float power_of_two(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// A bump with a NaN centre or width counts as active, so that the NaN propagates.
__device__ __forceinline__ Bump bump_at(float center, float log_width, float tau, bool exists) {
  Bump b;
  b.inverse_width = power_of_two(fminf(fmaxf(log_width * -kLog2e, -126.0f), 126.0f));
  if (log_width != log_width) b.inverse_width = log_width;
  b.u = (tau - center) * b.inverse_width;
  b.active = exists && !(fabsf(b.u) > kBasisReach);
  b.height = b.active ? power_of_two(b.u * b.u * -kLog2e) : 0.0f;  // NaN if u is NaN
  return b;
}

// Centre and log-width of the lane's bump; loaded ahead of their use.
struct Timing {
  float center, log_width;
};

__device__ __forceinline__ Timing timing_at(const float* centers, const float* log_widths, int64_t first, int bump,
                                            int64_t bumps) {
  if (bump >= bumps) return {0, 0};
  return {centers[first + bump], log_widths[first + bump]};
}

// The warp's Gaussian and the lane's channel of a row.
struct Place {
  int64_t gaussian;
  int lane, half, channel;
  bool has_channel;

  __device__ __forceinline__ Place()
      : gaussian(int64_t(blockIdx.x) * kWarps + threadIdx.x / 32),
        lane(int(threadIdx.x) & 31),
        half(lane >> 4),
        channel(lane & 15),
        has_channel(channel < int(kBasisChannels)) {}
};

// Range of rows from the first active bump to the last.
struct Span {
  int first, last;
};

__device__ __forceinline__ Span span_of(unsigned active) { return {__ffs(int(active)) - 1, 31 - __clz(int(active))}; }

__device__ __forceinline__ bool is_set(unsigned mask, int bit) { return (mask >> (bit & 31)) & 1u; }

// Sum over the channels of a row, returned to all lanes of the half warp.
__device__ __forceinline__ float sum_of_half(float x) {
#pragma unroll
  for (int offset = 8; offset > 0; offset /= 2) x += __shfl_xor_sync(kAll, x, offset);
  return x;
}

}  // namespace gsplat::basis_field
