// Front-to-back blending in half precision on tensor cores: splats staged as matrix operands, and groups of sixteen
// pixels. One matrix product evaluates the exponents of many splats at all pixels, another sums the colours, as in
// attention (Dao et al. 2022).
#pragma once

#include <cuda_fp16.h>

#include <cstddef>

#include "matrix_units.cuh"
#include "splats.cuh"

namespace gsplat::blending {
namespace {

// Opacities are scaled so that the smallest normal half-precision number corresponds to the alpha cut-off (1/255).
// Flushing denormals to zero then implements the cut-off. Before flushing, opacities are in units of kHalfUnits * kMaxAlpha.
constexpr float kHalfUnits = 64.875f;  // 2^-14 of them are 1/255 of 1 / 0.99, to within 4e-4
constexpr float kLog2HalfUnits = 6.0195907f;
constexpr float kGreatestHalf = 65504;
constexpr float kLowScale = 2048;

__device__ inline uint32_t bits_of(__half2 x) { return reinterpret_cast<const uint32_t&>(x); }

// Matrix operands of one splat: three rows for `ldmatrix`. Two rows hold the coefficients of `StagedSplat` in the order
// of PixelBasis, each as a sum of two halves (22 bits). The third holds the colours and a 1, whose weighted sum is the
// sum of the weights.
struct alignas(16) HalfSplat {
  uint4 high, low, colors;
};
static_assert(sizeof(HalfSplat) == sizeof(Record<4>));

// Monomials of the pixel coordinates that the coefficients are multiplied by, as pairs: 0 is (1, x), 1 is (y, x^2), 2
// is (x y, y^2), 3 is unused. They are exact in half precision at pixel centres. The scale factors extend the range of
// the coefficients. A lane holds one pair of one column.
struct PixelBasis {
  __half2 constant, by_y, by_yy;

  __device__ PixelBasis(int pair, float x) {
    constant = __floats2half2_rn(pair == 0 ? 16 : 0, pair == 0 ? 4 * x : pair == 1 ? x * x : 0);
    by_y = __floats2half2_rn(pair == 1 ? 4 : pair == 2 ? x : 0, 0);
    by_yy = __floats2half2_rn(0, pair == 2 ? 1 : 0);
  }
  // Compute the basis of a pixel and of the pixel below it; first for the high parts of the coefficients, then for the
  // low parts.
  __device__ void fill(float y, uint32_t (&basis)[4]) const {
#pragma unroll
    for (int i = 0; i < 2; ++i) {
      const __half2 both = __float2half2_rn(y + float(i)), high = __hfma2(__hfma2(by_yy, both, by_y), both, constant);
      basis[i] = bits_of(high);
      basis[i + 2] = bits_of(__hmul2(high, __float2half2_rn(1 / kLowScale)));
    }
  }
};

// Split each of two numbers into a sum of two halves. The second half is in units of 1 / kLowScale, which keeps it in
// the normal range.
__device__ inline void split(float2 pair, uint32_t& high, uint32_t& low) {
  const __half2 upper = __floats2half2_rn(pair.x, pair.y);
  high = bits_of(upper);
  low = pack_halves(kLowScale * (pair.x - __low2float(upper)), kLowScale * (pair.y - __high2float(upper)));
}

// Convert a record to matrix operands. `per_depth` scales the last channel into the range of half precision. Returns
// false if the splat is too thin for half precision (about 0.01 pixel) and must not be drawn. `out` may alias `r`.
__device__ inline bool stage_half_splat(const Record<4>& r, float x, float y, float per_depth, HalfSplat& out) {
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

// Load 8x8 matrices of halves from shared memory. Lane l supplies the address of row l % 8 of matrix l / 8. Lane 4 r +
// c receives the elements [r][2 c] and [r][2 c + 1] of each matrix, or of its transpose.
__device__ inline void load_matrices(uint32_t (&to)[4], uint32_t address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(address)
               : "memory");
}
__device__ inline void load_transposed(uint32_t (&to)[4], uint32_t address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
               : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3])
               : "r"(address)
               : "memory");
}
__device__ inline void load_transposed(uint32_t (&to)[2], uint32_t address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x2.trans.shared.b16 {%0, %1}, [%2];"
               : "=r"(to[0]), "=r"(to[1])
               : "r"(address)
               : "memory");
}
// Load a 16-bit shared-memory address of a splat from a list in shared memory.
__device__ inline uint32_t load_hit(uint32_t address) {
  uint16_t hit;
  asm volatile("ld.shared.u16 %0, [%1];" : "=h"(hit) : "r"(address) : "memory");
  return hit;
}
__device__ inline void store_hit(uint32_t address, uint32_t hit) {
  asm volatile("st.shared.u16 [%0], %1;" ::"r"(address), "h"(uint16_t(hit)) : "memory");
}

// Right-hand matrix operands of 8 kTiles splats. Rows are assigned to tiles such that lane q of a group of four
// receives the exponents of the 2 kTiles consecutive splats from 2 kTiles q on.
template <int kTiles>
struct HalfSplats {
  uint32_t shapes[kTiles / 2][4];  // for two tiles: high, low, high, low
  uint32_t colors[kTiles];

  // Load the operands of splats. `hits` is the shared-memory address of a list of the splats' addresses.
  __device__ explicit HalfSplats(uint32_t hits) {
    constexpr uint32_t kEachTile = 2 * sizeof(uint16_t);
    const int row = threadIdx.x % 8, matrix = threadIdx.x / 8 % 4;
    const uint32_t first = hits + sizeof(uint16_t) * (row / 2 * 2 * kTiles + row % 2);
    const uint32_t part = matrix % 2 == 0 ? offsetof(HalfSplat, high) : offsetof(HalfSplat, low);
#pragma unroll
    for (int i = 0; i < kTiles / 2; ++i) load_matrices(shapes[i], load_hit(first + kEachTile * (2 * i + matrix / 2)) + part);
    load_transposed(colors, load_hit(first + kEachTile * (matrix % kTiles)) + offsetof(HalfSplat, colors));
  }
};

// Return two opacities in units of kMaxAlpha; 0 below the cut-off.
__device__ inline __half2 opacity(float power0, float power1) {
  const uint32_t units = pack_halves(exp2_fast(power0), exp2_fast(power1));
  uint32_t alpha;
  asm("mul.rn.ftz.sat.f16x2 %0, %1, %2;" : "=r"(alpha) : "r"(units), "r"(pack_halves(kHalfUnits, kHalfUnits)));
  return reinterpret_cast<const __half2&>(alpha);
}

// Two rows of eight pixels. A group of four lanes holds two pixels, one above the other, and each lane processes a
// quarter of the splats.
struct HalfPixels {
  __half2 front;  // transmittance in front of the next splat; 0 once the pixel is closed
  // Two sums of the upper and two of the lower pixel: lane 0 has red and green, lane 1 blue and depth, lane 2 the weights (in
  // units of kMaxAlpha).
  float sums[4];

  __device__ bool open() const { return bits_of(front) != 0; }
};

// Blending weights of the splats that a lane processes, at the two pixels of its group, in units of kMaxAlpha.
template <int kTiles>
struct HalfWeights {
  __half2 weights[2 * kTiles];
  __half2 in_front, behind;  // transmittance in front of the lane's splats, and behind those of all four lanes

  // Compute the weights as if the transmittance in front of the lane's splats were 1, and the actual transmittances
  // `in_front` and `behind`. `blend` multiplies the weights by `in_front`.
  __device__ HalfWeights(const HalfPixels& pixels, const uint32_t (&basis)[4], const HalfSplats<kTiles>& splats) {
    const __half2 most = __float2half2_rn(kMaxAlpha);
    __half2 through;
#pragma unroll
    for (int i = 0; i < 2 * kTiles; i += 2) {
      float powers[4] = {};
      const uint32_t (&shapes)[4] = splats.shapes[i / 4];
      multiply_half(powers, basis, shapes[i % 4], shapes[i % 4 + 1]);
      weights[i] = opacity(powers[0], powers[2]);
      if (i > 0) weights[i] = __hmul2(weights[i], through);
      through = __hfma2(weights[i], __hneg2(most), i > 0 ? through : __float2half2_rn(1));
      weights[i + 1] = __hmul2(opacity(powers[1], powers[3]), through);
      through = __hfma2(weights[i + 1], __hneg2(most), through);
    }
    const __half2 beside = __shfl_xor_sync(kAll, through, 1), pair = __hmul2(through, beside);
    const __half2 other_pair = __shfl_xor_sync(kAll, pair, 2);
    behind = __hmul2(pixels.front, __hmul2(pair, other_pair));
    in_front = pixels.front;
    if (threadIdx.x & 2) in_front = __hmul2(in_front, other_pair);
    if (threadIdx.x & 1) in_front = __hmul2(in_front, beside);
  }

  // Return true if these splats reduce the transmittance of a pixel that was open below kMinTransmittance.
  __device__ bool closes(const HalfPixels& pixels) const {
    return !__hbge2(behind, __hmin2(pixels.front, __float2half2_rn(kMinTransmittance)));
  }
  // Remove the splat at which a pixel closes, and all splats behind it.
  __device__ void cut() {
    const __half2 most = __float2half2_rn(kMaxAlpha), stop = __float2half2_rn(kMinTransmittance);
    __half2 through = __float2half2_rn(1);
#pragma unroll
    for (__half2& weight : weights) {
      through = __hfma2(weight, __hneg2(most), through);
      weight = __hmul2(weight, __hge2(__hmul2(in_front, through), stop));
    }
    behind = __hmul2(behind, __hge2(behind, stop));
  }
  __device__ void blend(const HalfSplats<kTiles>& splats, HalfPixels& pixels) {
    pixels.front = behind;
#pragma unroll
    for (__half2& weight : weights) weight = __hmul2(weight, in_front);
#pragma unroll
    for (int i = 0; i < 2 * kTiles; i += 4)
      multiply_half(
          pixels.sums,
          {bits_of(__lows2half2(weights[i], weights[i + 1])), bits_of(__highs2half2(weights[i], weights[i + 1])),
           bits_of(__lows2half2(weights[i + 2], weights[i + 3])), bits_of(__highs2half2(weights[i + 2], weights[i + 3]))},
          splats.colors[i / 2], splats.colors[i / 2 + 1]);
  }
};

}  // namespace

}  // namespace gsplat::blending
