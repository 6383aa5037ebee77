// Front-to-back blending of sixteen pixels in half precision on the tensor cores: the powers of many splats at all the pixels are
// one matrix product, and so are the sums of the colours, as in attention (Dao et al. 2022).
#pragma once

#include <cstddef>

#include "half_splats.cuh"

namespace {

// Loads 8x8 matrices of halves from shared memory: lane l gives the address of row l % 8 of matrix l / 8. Lane 4 r + c gets the
// elements [r][2 c] and [r][2 c + 1] of each, or of each transposed.
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
// Addresses of splats in shared memory, of 16 bits, which are there in turn.
__device__ inline uint32_t load_hit(uint32_t address) {
  uint16_t hit;
  asm volatile("ld.shared.u16 %0, [%1];" : "=h"(hit) : "r"(address) : "memory");
  return hit;
}
__device__ inline void store_hit(uint32_t address, uint32_t hit) {
  asm volatile("st.shared.u16 [%0], %1;" ::"r"(address), "h"(uint16_t(hit)) : "memory");
}

// 8 kTiles splats as right-hand sides of matrix products. Lane q of a group of four gets the powers of the 2 kTiles splats from
// 2 kTiles q on, in their order: that is how the rows are dealt out to the tiles.
template <int kTiles>
struct HalfSplats {
  uint32_t shapes[kTiles / 2][4];  // of two tiles: high, low, high, low
  uint32_t colors[kTiles];

  // At `hits` in shared memory are the addresses of the splats.
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

// Of 1 / 0.99; 0 below the cut-off.
__device__ inline __half2 opacity(float power0, float power1) {
  const uint32_t units = pack_halves(exp2_fast(power0), exp2_fast(power1));
  uint32_t alpha;
  asm("mul.rn.ftz.sat.f16x2 %0, %1, %2;" : "=r"(alpha) : "r"(units), "r"(pack_halves(kHalfUnits, kHalfUnits)));
  return reinterpret_cast<const __half2&>(alpha);
}

// Two rows of eight pixels. A group of four lanes has two pixels, one above the other, and a share of the splats each.
struct HalfPixels {
  __half2 front;  // the transmittance in front of the next splat; 0 once the pixel is closed
  float sums[4];  // of the upper pixel and of the lower: lane 0 has red and green, 1 blue and depth, 2 the weights (of 1 / 0.99)

  __device__ bool open() const { return bits_of(front) != 0; }
};

// The weights of the splats of a lane at its two pixels.
template <int kTiles>
struct HalfWeights {
  __half2 weights[2 * kTiles];
  __half2 in_front, behind;  // the transmittance in front of the lane's splats, and behind those of all four lanes

  // The weights are as if nothing were in front of the lane's splats.
  __device__ HalfWeights(const HalfPixels& pixels, const uint32_t (&basis)[4], const HalfSplats<kTiles>& splats) {
    const __half2 most = __float2half2_rn(0.99f);
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

  // Whether a pixel that was open is not open behind these splats.
  __device__ bool closes(const HalfPixels& pixels) const {
    return !__hbge2(behind, __hmin2(pixels.front, __float2half2_rn(kStop)));
  }
  // Takes out the splats that would close a pixel, and what is behind them.
  __device__ void cut() {
    const __half2 most = __float2half2_rn(0.99f), stop = __float2half2_rn(kStop);
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
