// Sums over the 64 pixels of a warp's quadrant for eight splats at a time, as small matrix products on tensor cores.
//
// A pixel's terms of a splat's gradient are s = alpha dL/dalpha for the shape and w for the colours. The moments are S
// Phi with Phi = (1, x, y, x^2, xy, y^2) of every pixel, exact in tf32. The colours' gradients are W V with V =
// dL/dcolour. Values that are not exact in tf32 are split into two tf32 numbers, which gives float32 accuracy.
#pragma once

#include "splats.cuh"

namespace gsplat::blending {
namespace {

constexpr int kSlots = 8;       // splats summed per product
constexpr int kTermLanes = 36;  // the lanes' terms of one splat, padded against bank conflicts
constexpr int kSteps = 4;       // a product sums over 8 of the 32 lanes

// A lane's terms of a splat: s and w of its two pixels.
using SplatTerms = float4[kSlots][kTermLanes];

__device__ inline float upper_bits(float x) { return __uint_as_float(__float_as_uint(x) & 0xffffe000u); }  // truncated to tf32

// sums += a b, where a is 16x8 and b is 8x8; lane 4 r + c holds a[r][c], a[r + 8][c], a[r][c + 4], a[r + 8][c + 4], b[c][r],
// b[c + 4][r] and the sums of [r][2 c], [r][2 c + 1], [r + 8][2 c], [r + 8][2 c + 1].
__device__ inline void multiply_add(float (&sums)[4], float a0, float a1, float a2, float a3, const float (&b)[2]) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
      : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
      : "r"(__float_as_uint(a0)), "r"(__float_as_uint(a1)), "r"(__float_as_uint(a2)), "r"(__float_as_uint(a3)),
        "r"(__float_as_uint(b[0])), "r"(__float_as_uint(b[1])));
}

// Right-hand operands of a warp: the contributions of its pixels per unit of s and of w.
template <int D>
struct PixelFactors {
  static constexpr int kColorTiles = (2 * D + 7) / 8;  // columns: the upper and lower parts of every channel
  float moments[kSteps][2];                            // of the lanes' first pixels, relative to the centre of their rows
  float colors[kColorTiles][kSteps][kPixelsEach][2];

  // Build the operands from dL/dcolour of each lane's pixels. The whole warp must call it; `terms` is used as scratch.
  __device__ PixelFactors(const float (&v_color)[kPixelsEach][D], SplatTerms& terms) {
    static_assert(sizeof(float[kPixelsEach][32][D]) <= sizeof(SplatTerms));
    auto& colors_of_lanes = reinterpret_cast<float (&)[kPixelsEach][32][D]>(terms);
    const int lane = threadIdx.x & 31, row = lane / 4, column = lane % 4;
#pragma unroll
    for (int p = 0; p < kPixelsEach; ++p)
      for (int d = 0; d < D; ++d) colors_of_lanes[p][lane][d] = v_color[p][d];
    __syncwarp();
#pragma unroll
    for (int step = 0; step < kSteps; ++step) {
      const float y = float(row_of_lane(8 * step, 0)) - 2.5f;
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const float x = float(column + 4 * half) - 3.5f;
        const float powers[6] = {1, x, y, x * x, x * y, y * y};
        float value = 0;
#pragma unroll
        for (int i = 0; i < 6; ++i) value = row == i ? powers[i] : value;
        moments[step][half] = value;
#pragma unroll
        for (int tile = 0; tile < kColorTiles; ++tile) {
          const int d = 4 * tile + row / 2;
#pragma unroll
          for (int p = 0; p < kPixelsEach; ++p) {
            const float v = d < D ? colors_of_lanes[p][8 * step + 4 * half + column][d] : 0;
            colors[tile][step][p][half] = row % 2 == 0 ? upper_bits(v) : v - upper_bits(v);
          }
        }
      }
    }
    __syncwarp();
  }
};

// Sum the terms of eight splats over the warp. Lane 4 r + c receives for splat r: in `moments` two of the sums of s (1,
// x | y, x^2 | xy, y^2 for c = 0, 1, 2; unused for c = 3) relative to the quadrant's centre, in `colors` the sums of w
// dL/dcolour of channels c and c + 4.
template <int D>
__device__ inline void sum_terms(const SplatTerms& terms, const PixelFactors<D>& factors, float (&moments)[2],
                                 float (&colors)[PixelFactors<D>::kColorTiles]) {
  constexpr int kTiles = PixelFactors<D>::kColorTiles;
  const int row = (threadIdx.x & 31) / 4, column = threadIdx.x % 4;
  float shape[4] = {}, color[kTiles][4] = {};  // shape: of the first pixels, then of the second pixels
#pragma unroll
  for (int step = 0; step < kSteps; ++step) {
    const float4 a = terms[row][8 * step + column], b = terms[row][8 * step + 4 + column];
    const float4 upper_a = make_float4(upper_bits(a.x), upper_bits(a.y), upper_bits(a.z), upper_bits(a.w));
    const float4 upper_b = make_float4(upper_bits(b.x), upper_bits(b.y), upper_bits(b.z), upper_bits(b.w));
    multiply_add(shape, upper_a.x, upper_a.y, upper_b.x, upper_b.y, factors.moments[step]);
    multiply_add(shape, a.x - upper_a.x, a.y - upper_a.y, b.x - upper_b.x, b.y - upper_b.y, factors.moments[step]);
#pragma unroll
    for (int tile = 0; tile < kTiles; ++tile) {
      multiply_add(color[tile], upper_a.z, a.z - upper_a.z, upper_b.z, b.z - upper_b.z, factors.colors[tile][step][0]);
      multiply_add(color[tile], upper_a.w, a.w - upper_a.w, upper_b.w, b.w - upper_b.w, factors.colors[tile][step][1]);
    }
  }
  // The centres of the first and second pixels' rows are one pixel above and below the quadrant's centre.
  const float more = shape[2] - shape[0], more_x = shape[3] - shape[1], all = shape[0] + shape[2];
  const float more_of_s = __shfl_sync(kAll, more, 4 * row), more_of_x = __shfl_sync(kAll, more_x, 4 * row);
  const float more_of_y = __shfl_sync(kAll, more, 4 * row + 1), all_of_s = __shfl_sync(kAll, all, 4 * row);
  moments[0] = all + (column == 1 ? more_of_s : column == 2 ? more_of_x : 0);
  moments[1] = shape[1] + shape[3] + (column == 2 ? fmaf(2, more_of_y, all_of_s) : 0);
#pragma unroll
  for (int tile = 0; tile < kTiles; ++tile) colors[tile] = (color[tile][0] + color[tile][2]) + (color[tile][1] + color[tile][3]);
}

}  // namespace

}  // namespace gsplat::blending
