// Network layers in the registers of a warp that processes 16 Gaussians, in float32 or half precision.
#pragma once

#include "matrix_units.cuh"
#include "network.h"

namespace gsplat::hexplane {

// 16 bytes of features in registers.
template <class T>
struct Piece;

template <>
struct Piece<float> {
  float v[4];
  __device__ static Piece load(const float* p) {
    const float4 x = *reinterpret_cast<const float4*>(p);
    return {{x.x, x.y, x.z, x.w}};
  }
  __device__ void modulate(const Piece& a, const Piece& b, float fraction) {
#pragma unroll
    for (int i = 0; i < 4; ++i) v[i] *= a.v[i] + fraction * (b.v[i] - a.v[i]);
  }
};

template <>
struct Piece<__half> {
  __half2 v[4];
  __device__ static Piece load(const __half* p) {
    const uint4 x = *reinterpret_cast<const uint4*>(p);
    Piece out;
    *reinterpret_cast<uint4*>(out.v) = x;
    return out;
  }
  __device__ void modulate(const Piece& a, const Piece& b, float fraction) {
    const __half2 f = __float2half2_rn(fraction);
#pragma unroll
    for (int i = 0; i < 4; ++i) v[i] = __hmul2(v[i], __hfma2(f, __hsub2(b.v[i], a.v[i]), a.v[i]));
  }
};

__device__ __forceinline__ uint32_t bits_of(__half2 x) { return *reinterpret_cast<uint32_t*>(&x); }

// Exchange halves of two adjacent rows between lanes. Before, the even row's lanes hold the first half of both rows
// (`a` of the even row, `b` of the odd row), and the odd row's lanes hold the second halves. Afterwards `a` and `b` are
// the two halves of the lane's own row.
template <class T>
__device__ __forceinline__ void exchange_halves(Piece<T>& a, Piece<T>& b, bool odd) {
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const auto own = odd ? b.v[i] : a.v[i], other = __shfl_xor_sync(0xffffffffu, odd ? a.v[i] : b.v[i], 4);
    a.v[i] = odd ? other : own;
    b.v[i] = odd ? own : other;
  }
}

// sums[t] += the pieces of two rows times the first layer's weights. `w` points to the lane's column in the row of
// block 0.
template <int kBlocks>
__device__ __forceinline__ void first_layer(float (&sums)[kBlocks][4], const Piece<__half> (&x)[2], const __half* w, int stride) {
  const uint32_t a0[4] = {bits_of(x[0].v[0]), bits_of(x[1].v[0]), bits_of(x[0].v[1]), bits_of(x[1].v[1])};
  const uint32_t a1[4] = {bits_of(x[0].v[2]), bits_of(x[1].v[2]), bits_of(x[0].v[3]), bits_of(x[1].v[3])};
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    const uint4 b = *reinterpret_cast<const uint4*>(w + t * 8 * stride);
    multiply_half(sums[t], a0, b.x, b.y);
    multiply_half(sums[t], a1, b.z, b.w);
  }
}

template <int kBlocks>
__device__ __forceinline__ void first_layer(float (&sums)[kBlocks][4], const Piece<float> (&x)[2], const float* w, int stride) {
  const SplitLeft a0(x[0].v[0], x[1].v[0], x[0].v[1], x[1].v[1]), a1(x[0].v[2], x[1].v[2], x[0].v[3], x[1].v[3]);
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    const float4 b = *reinterpret_cast<const float4*>(w + t * 8 * stride);
    multiply_split(sums[t], a0, b.x, b.y);
    multiply_split(sums[t], a1, b.z, b.w);
  }
}

// Compute the next layer. Its inputs are the previous layer's sums, in their register layout.
template <int kIn, int kOut>
__device__ __forceinline__ void next_layer(const float (&in)[kIn][4], float (&sums)[kOut][4], const __half* w, int stride) {
#pragma unroll
  for (int k = 0; k < kIn; k += 2) {
    const uint32_t a[4] = {pack_halves(in[k][0], in[k][1]), pack_halves(in[k][2], in[k][3]),
                           pack_halves(in[k + 1][0], in[k + 1][1]), pack_halves(in[k + 1][2], in[k + 1][3])};
#pragma unroll
    for (int t = 0; t < kOut; ++t) {
      const uint2 b = *reinterpret_cast<const uint2*>(w + t * 8 * stride + k * 8);
      multiply_half(sums[t], a, b.x, b.y);
    }
  }
}

template <int kIn, int kOut>
__device__ __forceinline__ void next_layer(const float (&in)[kIn][4], float (&sums)[kOut][4], const float* w, int stride) {
#pragma unroll
  for (int k = 0; k < kIn; ++k) {
    const SplitLeft a(in[k][0], in[k][2], in[k][1], in[k][3]);
#pragma unroll
    for (int t = 0; t < kOut; ++t) {
      const float2 b = *reinterpret_cast<const float2*>(w + t * 8 * stride + k * 8);
      multiply_split(sums[t], a, b.x, b.y);
    }
  }
}

template <int kBlocks>
__device__ __forceinline__ void start_with_bias(float (&sums)[kBlocks][4], const float* bias, int quad) {
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    sums[t][0] = sums[t][2] = bias[8 * t + 2 * quad];
    sums[t][1] = sums[t][3] = bias[8 * t + 2 * quad + 1];
  }
}

}  // namespace gsplat::hexplane
