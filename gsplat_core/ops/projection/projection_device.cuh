// Parts of CUDA projection shared by the separate op, the fused rasterization and render_frame.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "projection_math.h"

namespace gsplat::projection {
namespace {

using namespace GSPLAT_ISA::projection;

__device__ inline Geometry load_geometry(const ProjectionInput& in, int64_t n) {
  if (in.covars != nullptr) {
    Symmetric3 sigma;
    for (int k = 0; k < 6; ++k) sigma.v[k] = in.covars[6 * n + k];
    return geometry_of(sigma);
  }
  float quat[4], scales[3];
  for (int k = 0; k < 4; ++k) quat[k] = in.quats[4 * n + k];
  for (int k = 0; k < 3; ++k) scales[k] = in.scales[3 * n + k];
  return geometry_of(quat, scales);
}

// a b - c d without cancellation if the products are nearly equal (Kahan; Jeannerod et al. 2013).
__device__ inline float difference_of_products(float a, float b, float c, float d) {
  const float cd = __fmul_rn(c, d);
  return fmaf(a, b, -cd) + fmaf(-c, d, cd);
}

// Gradients of the projected mean and of the blurred covariance S = (a, b; b, c) (symmetric): S^-1 m and 1/2 S^-1 M
// S^-1, with m and M the moments of first and second order. They are computed along the ellipse's axes u and w. In x
// and y the component along the length of a thin splat would be lost to rounding, because it is smaller by the squared
// ratio of the axes.
struct EllipseGradient {
  float mean[2], covariance[3];
};
__device__ inline EllipseGradient ellipse_gradient(float a, float b, float c, const float* m) {
  const float half = 0.5f * (a - c), radius = ::sqrtf(half * half + b * b);
  const float longer = 0.5f * (a + c) + radius, shorter = difference_of_products(a, c, b, b) / longer;
  float x = half < 0 ? b : half + radius, y = half < 0 ? radius - half : b;  // u; w is (-y, x)
  const float norm = ::sqrtf(x * x + y * y);
  x = norm > 0 ? x / norm : 1;
  y = norm > 0 ? y / norm : 0;
  const float m_u = (x * m[1] + y * m[2]) / longer, m_w = difference_of_products(x, m[2], y, m[1]) / shorter;
  const float wx = difference_of_products(x, m[4], y, m[3]), wy = difference_of_products(x, m[5], y, m[4]);  // M w
  const float uu = (x * (x * m[3] + y * m[4]) + y * (x * m[4] + y * m[5])) / (longer * longer);
  const float uw = (x * wx + y * wy) / (longer * shorter), ww = difference_of_products(x, wy, y, wx) / (shorter * shorter);
  return {{x * m_u - y * m_w, y * m_u + x * m_w},
          {0.5f * (x * x * uu - 2 * x * y * uw + y * y * ww), 0.5f * (x * y * (uu - ww) + (x * x - y * y) * uw),
           0.5f * (y * y * uu + 2 * x * y * uw + x * x * ww)}};
}

// Number of gradient sums per camera: rotation row by row, then translation. Further values may follow.
constexpr int kMatrixSums = 12;

// Sum kSums values per thread over the block in a fixed order: halves of a warp, then warp by warp.
template <int kSums, int kBlock>
__device__ inline void sum_over_block(const float* v, float* to) {
  __shared__ float warps[kBlock / 32][kSums];
  for (int i = 0; i < kSums; ++i) {
    float x = v[i];
    for (int half = 16; half > 0; half /= 2) x += __shfl_down_sync(~0u, x, half);
    if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32][i] = x;
  }
  __syncthreads();
  if (threadIdx.x < kSums) {
    float total = 0;
    for (int w = 0; w < kBlock / 32; ++w) total += warps[w][threadIdx.x];
    to[threadIdx.x] = total;
  }
  __syncthreads();
}

// One warp per image and sum: each lane adds every 32nd block, and the lanes are added in a fixed order. `centers`
// receives the values after the first kMatrixSums; it may be null.
template <int kSums>
__global__ void sum_over_blocks(const float* sums, int64_t blocks, float* viewmats, float* centers) {
  const int64_t image = blockIdx.x;
  const int i = threadIdx.x / 32, lane = threadIdx.x % 32;
  double total = 0;
  for (int64_t block = lane; block < blocks; block += 32) total += sums[(image * blocks + block) * kSums + i];
  for (int half = 16; half > 0; half /= 2) total += __shfl_down_sync(~0u, total, half);
  if (lane > 0) return;
  if (i < kMatrixSums) {
    viewmats[image * 16 + (i < 9 ? i / 3 * 4 + i % 3 : (i - 9) * 4 + 3)] = float(total);
  } else if (centers != nullptr) {
    centers[image * (kSums - kMatrixSums) + i - kMatrixSums] = float(total);
  }
}

}  // namespace
}  // namespace gsplat::projection
