// Spherical-harmonics coefficients in shared memory, and the gradient of a view direction; used by all CUDA kernels
// that evaluate colours.
#pragma once

#include <cuda_fp16.h>

#include <cstdint>
#include <cstring>

#include "spherical_harmonics_bases.h"

namespace gsplat::spherical_harmonics {
namespace {

using namespace GSPLAT_ISA::spherical_harmonics;

template <int degree>
constexpr int kBasesOf = (degree + 1) * (degree + 1);

__device__ inline float to_float(float x) { return x; }
__device__ inline float to_float(__half x) { return __half2float(x); }

template <int bytes>
__device__ inline void copy_async(void* to, const void* from) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to));
  if constexpr (bytes == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at), "l"(from) : "memory");
  }
}

// Coefficients of a warp's 32 Gaussians, one row per lane: the 3 (degree + 1)^2 that the degree uses. A lane loading
// its own row would touch one sector of global memory per value, so the warp copies its rows together. The row stride
// is an odd number of 16-byte words, so that eight lanes reading the same word of their rows have no bank conflict.
// Rows in global memory may be longer than the degree needs.
template <int degree, class Coefficient = float>
struct StagedHarmonics {
  static constexpr int kUsed = 3 * kBasesOf<degree>, kInQuad = 16 / sizeof(Coefficient);
  static constexpr int kQuads = (kUsed + kInQuad - 1) / kInQuad, kStride = kInQuad * (kQuads | 1);
  uint4 rows[32 * kStride / kInQuad];

  __device__ Coefficient* row(int lane) { return reinterpret_cast<Coefficient*>(rows) + lane * kStride; }

  // Start copying the rows with a bit in `wanted`; `wait` completes the copies. The whole warp must call it.
  // `row_length`: coefficients per row in global memory. `aligned`: `from` is aligned to 16 bytes.
  __device__ void load(const Coefficient* from, int row_length, unsigned wanted, bool aligned) {
    const int lane = threadIdx.x & 31;
    Coefficient* const to = reinterpret_cast<Coefficient*>(rows);
    if (row_length % kInQuad == 0 && aligned) {
#pragma unroll 4
      for (int i = lane; i < 32 * kQuads; i += 32) {
        const int set = i / kQuads, quad = i % kQuads;
        if (wanted >> set & 1) copy_async<16>(to + set * kStride + kInQuad * quad, from + set * row_length + kInQuad * quad);
      }
    } else {
#pragma unroll 4
      for (int i = lane; i < 32 * kUsed; i += 32) {
        const int set = i / kUsed, place = i % kUsed;
        if (!(wanted >> set & 1)) continue;
        if constexpr (sizeof(Coefficient) == 4) {
          copy_async<4>(to + set * kStride + place, from + set * row_length + place);
        } else {
          to[set * kStride + place] = from[set * row_length + place];
        }
      }
    }
  }
  __device__ static void wait() {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
  }

  // Read the calling lane's coefficients as float32.
  __device__ void read(float (&values)[kInQuad * kQuads]) const {
    const uint4* const row = rows + (threadIdx.x & 31) * (kStride / kInQuad);
#pragma unroll
    for (int i = 0; i < kQuads; ++i) {
      const uint4 quad = row[i];
      Coefficient of_quad[kInQuad];
      memcpy(of_quad, &quad, sizeof(quad));
#pragma unroll
      for (int j = 0; j < kInQuad; ++j) values[kInQuad * i + j] = to_float(of_quad[j]);
    }
  }

  // Add the colour of the calling lane's Gaussian, given the basis functions of its view direction.
  __device__ void add_color(const float (&bases)[kBasesOf<degree>], float (&color)[3]) const {
    float values[kInQuad * kQuads];
    read(values);
#pragma unroll
    for (int k = 0; k < kBasesOf<degree>; ++k)
      for (int j = 0; j < 3; ++j) color[j] = fmaf(bases[k], values[3 * k + j], color[j]);
  }

  // Write the first `count` rows, with zeros for coefficients that the degree does not use. The whole warp must call it
  // after a __syncwarp.
  __device__ void store(Coefficient* to, int row_length, int count) const {
    static_assert(sizeof(Coefficient) == 4);
    const int lane = threadIdx.x & 31;
    const float* const values = reinterpret_cast<const float*>(rows);
    if (row_length % 4 == 0 && reinterpret_cast<uintptr_t>(to) % 16 == 0) {
      const int quads = row_length / 4;
      for (int i = lane; i < count * quads; i += 32) {
        const int set = i / quads, quad = i % quads;
        float4 q = make_float4(0, 0, 0, 0);
        if (quad < kQuads) {
          q = *reinterpret_cast<const float4*>(values + set * kStride + 4 * quad);
          if (4 * quad + 1 >= kUsed) q.y = 0;
          if (4 * quad + 2 >= kUsed) q.z = 0;
          if (4 * quad + 3 >= kUsed) q.w = 0;
        }
        reinterpret_cast<float4*>(to)[i] = q;
      }
    } else {
      for (int i = lane; i < count * row_length; i += 32) {
        const int set = i / row_length, place = i % row_length;
        to[i] = place < kUsed ? values[set * kStride + place] : 0;
      }
    }
  }
};

// Compute the unit vector from the camera centre to the Gaussian. Returns the inverse of their distance.
__device__ inline float unit_direction(const float (&center)[3], const float* mean, float (&direction)[3]) {
  float squared = 0;
  for (int k = 0; k < 3; ++k) {
    direction[k] = mean[k] - center[k];
    squared = fmaf(direction[k], direction[k], squared);
  }
  const float inverse = 1.0f / ::sqrtf(squared);
  for (int k = 0; k < 3; ++k) direction[k] *= inverse;
  return inverse;
}

// Gradient of a vector whose unit vector is `direction` and whose inverse length is `inverse`, from the gradient v of a
// colour with the coefficients c.
template <int degree>
__device__ inline void direction_gradient(const float (&direction)[3], float inverse, const float* c, const float (&v)[3],
                                          float (&gradient)[3]) {
  float v_b[kBasesOf<degree>] = {}, g[3];
#pragma unroll
  for (int k = 1; k < kBasesOf<degree>; ++k) v_b[k] = v[0] * c[3 * k] + v[1] * c[3 * k + 1] + v[2] * c[3 * k + 2];
  bases_backward<degree>(direction[0], direction[1], direction[2], v_b, g, g + 1, g + 2);
  const float along = g[0] * direction[0] + g[1] * direction[1] + g[2] * direction[2];
  for (int k = 0; k < 3; ++k) gradient[k] = (g[k] - along * direction[k]) * inverse;
}

}  // namespace
}  // namespace gsplat::spherical_harmonics
