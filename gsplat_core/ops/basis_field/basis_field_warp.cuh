// A warp and the bumps of its Gaussian: 32 bumps side by side to find the active ones, then two active bumps at a time, each a
// row of 13 channels for a half of the warp. Neighbouring active bumps' rows lie side by side, so the halves read one stretch.
#pragma once

#include "basis_field_cuda.h"

namespace basis_warp {

constexpr unsigned kAll = ~0u;
constexpr int kBlock = 256;  // threads
constexpr int kWarps = kBlock / 32;
constexpr float kLog2e = 1.44269504f;

struct Bump {
  float u, inverse_width, height;  // height is exp(-u^2), zero where inactive
  bool active;
};

// NaN in a centre or width is active, so that it shows in the result.
__device__ __forceinline__ Bump bump_at(float center, float log_width, float tau, bool exists) {
  Bump b;
  const float exponent = fminf(fmaxf(log_width * -kLog2e, -126.0f), 126.0f);
  b.inverse_width = log_width == log_width ? exp2f(exponent) : log_width;
  b.u = (tau - center) * b.inverse_width;
  b.active = exists && !(fabsf(b.u) > kBasisReach);
  b.height = !b.active ? 0.0f : b.u == b.u ? exp2f(b.u * b.u * -kLog2e) : b.u;
  return b;
}

// This warp's Gaussian, and the part of a row that a lane has.
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

// Takes the next two set bits of `left`: the bump of the lane's half, or -1 where the second half has none.
__device__ __forceinline__ int next_row(unsigned& left, int half) {
  const int first = __ffs(int(left)) - 1;
  left &= left - 1;
  const int second = __ffs(int(left)) - 1;
  left &= left - 1;
  return half ? second : first;
}

// Sum over the channels of a row, for all lanes of its half.
__device__ __forceinline__ float sum_of_half(float x) {
#pragma unroll
  for (int offset = 8; offset > 0; offset /= 2) x += __shfl_xor_sync(kAll, x, offset);
  return x;
}

}  // namespace basis_warp
