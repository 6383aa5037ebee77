// Splats of a window in shared memory, as the tensor cores take them to blend in half precision.
#pragma once

#include <cuda_fp16.h>

#include "matrix_units.cuh"
#include "staged_splats.cuh"

namespace {

// Half precision's smallest normal number stands for the faintest opacity that is drawn, so that flushing what is smaller to zero
// is the cut-off: opacities are counted in units of 1 / kHalfUnits until then.
constexpr float kHalfUnits = 64.875f;  // 2^-14 of them are 1/255 of 1 / 0.99, but for 4e-4
constexpr float kLog2HalfUnits = 6.0195907f;
constexpr float kGreatestHalf = 65504;
constexpr float kLowScale = 2048;

__device__ inline uint32_t bits_of(__half2 x) { return reinterpret_cast<const uint32_t&>(x); }

// The coefficients of `StagedSplat`, each as the sum of two halves, in the order of PixelBasis: 22 bits. Then the colours and
// a 1, whose sum over the splats is that of their weights. Each of the three is a row of a matrix for `ldmatrix`.
struct alignas(16) HalfSplat {
  uint4 high, low, colors;
};
static_assert(sizeof(HalfSplat) == sizeof(Record<4>));

// What the coefficients are multiplied by at (x, y), as pairs: 0 is (1, x), 1 is (y, x^2), 2 is (x y, y^2), 3 is nothing; exact
// in half precision at pixel centres. The factors extend the range of the coefficients. A lane has one pair, of one column.
struct PixelBasis {
  __half2 constant, by_y, by_yy;

  __device__ PixelBasis(int pair, float x) {
    constant = __floats2half2_rn(pair == 0 ? 16 : 0, pair == 0 ? 4 * x : pair == 1 ? x * x : 0);
    by_y = __floats2half2_rn(pair == 1 ? 4 : pair == 2 ? x : 0, 0);
    by_yy = __floats2half2_rn(0, pair == 2 ? 1 : 0);
  }
  // For a pixel and the one below it; first for the coefficients' high parts, then for the low ones.
  __device__ void put(float y, uint32_t (&basis)[4]) const {
#pragma unroll
    for (int i = 0; i < 2; ++i) {
      const __half2 both = __float2half2_rn(y + float(i)), high = __hfma2(__hfma2(by_yy, both, by_y), both, constant);
      basis[i] = bits_of(high);
      basis[i + 2] = bits_of(__hmul2(high, __float2half2_rn(1 / kLowScale)));
    }
  }
};

// Two numbers as sums of two halves each, the second of which counts in units of 1 / kLowScale, so that it does not get too
// small.
__device__ inline void split(float2 pair, uint32_t& high, uint32_t& low) {
  const __half2 upper = __floats2half2_rn(pair.x, pair.y);
  high = bits_of(upper);
  low = pack_halves(kLowScale * (pair.x - __low2float(upper)), kLowScale * (pair.y - __high2float(upper)));
}

// `per_depth` brings the last channel into the range of half precision. Returns false, and the splat must not be drawn, where it
// is so thin (a hundredth of a pixel) that half precision does not reach. `out` may be where `r` came from.
__device__ inline bool put_half_splat(const Record<4>& r, float x, float y, float per_depth, HalfSplat& out) {
  const StagedSplat<4> s = staged(r, x, y);
  const float2 pairs[3] = {{(s.k - kLog2HalfUnits) / 16, s.by_x / 4}, {s.by_y / 4, s.by_xx}, {s.by_xy, s.by_yy}};
  uint4 high = {}, low = {};
  split(pairs[0], high.x, low.x);
  split(pairs[1], high.y, low.y);
  split(pairs[2], high.z, low.z);
  out.high = high;
  out.low = low;
  out.colors = {pack_halves(fminf(s.colors[0], kGreatestHalf), fminf(s.colors[1], kGreatestHalf)),
                pack_halves(fminf(s.colors[2], kGreatestHalf), s.colors[3] * per_depth), pack_halves(1, 0), 0};
  float size = 0;
  for (const float2& pair : pairs) size += fabsf(pair.x) + fabsf(pair.y);
  return size < kGreatestHalf;
}

}  // namespace
