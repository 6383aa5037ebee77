#include "covariance.h"
#include "covariance_math.h"
#include "cuda_scratch.h"

namespace gsplat::covariance {
namespace {

using namespace GSPLAT_ISA::covariance;

__global__ void __launch_bounds__(kThreads) forward(const float* __restrict__ quats, const float* __restrict__ scales,
                                                    float* __restrict__ out, bool inverse, bool triu, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  float q[4], s[3];
  for (int k = 0; k < 4; ++k) q[k] = quats[4 * i + k];
  for (int k = 0; k < 3; ++k) s[k] = inverse ? 1.0f / scales[3 * i + k] : scales[3 * i + k];
  const Symmetric3 c = outer_square(rotation_of(normalise(q)), s);
  if (triu) {
    for (int k = 0; k < 6; ++k) out[6 * i + k] = c.v[k];
  } else {
    const float full[9] = {c.v[0], c.v[1], c.v[2], c.v[1], c.v[3], c.v[4], c.v[2], c.v[4], c.v[5]};
    for (int k = 0; k < 9; ++k) out[9 * i + k] = full[k];
  }
}

// Return the gradient as a symmetric matrix: each of two equal off-diagonal elements receives half of their sum.
__device__ Symmetric3 symmetric(const float* v, bool triu, int64_t i) {
  if (triu) {
    v += 6 * i;
    return {{v[0], 0.5f * v[1], 0.5f * v[2], v[3], 0.5f * v[4], v[5]}};
  }
  v += 9 * i;
  return {{v[0], 0.5f * (v[1] + v[3]), 0.5f * (v[2] + v[6]), v[4], 0.5f * (v[5] + v[7]), v[8]}};
}

__global__ void __launch_bounds__(kThreads)
    backward(const float* __restrict__ quats, const float* __restrict__ scales, const float* __restrict__ v_covars,
             const float* __restrict__ v_precis, bool triu, float* __restrict__ v_quats, float* __restrict__ v_scales,
             int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count) return;
  float q[4], s[3], v_q[4], v_s[3] = {};
  for (int k = 0; k < 4; ++k) q[k] = quats[4 * i + k];
  for (int k = 0; k < 3; ++k) s[k] = scales[3 * i + k];
  const UnitQuat quat = normalise(q);
  const Matrix3 rotation = rotation_of(quat);
  Matrix3 v_rotation = {};
  if (v_covars != nullptr) outer_square_backward(rotation, s, symmetric(v_covars, triu, i), v_rotation, v_s);
  if (v_precis != nullptr) {
    float inverse[3], v_inverse[3];
    for (int k = 0; k < 3; ++k) inverse[k] = 1.0f / s[k];
    outer_square_backward(rotation, inverse, symmetric(v_precis, triu, i), v_rotation, v_inverse);
    for (int k = 0; k < 3; ++k) v_s[k] -= v_inverse[k] * inverse[k] * inverse[k];
  }
  rotation_backward(quat, v_rotation, v_q);
  for (int k = 0; k < 4; ++k) v_quats[4 * i + k] = v_q[k];
  for (int k = 0; k < 3; ++k) v_scales[3 * i + k] = v_s[k];
}

}  // namespace

void covariance_forward(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t count,
                        cudaStream_t stream) {
  if (count == 0) return;
  forward<<<blocks_for(count), kThreads, 0, stream>>>(quats, scales, out, inverse, triu, count);
}

void covariance_backward(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                         float* v_quats, float* v_scales, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  backward<<<blocks_for(count), kThreads, 0, stream>>>(quats, scales, v_covars, v_precis, triu, v_quats, v_scales, count);
}

}  // namespace gsplat::covariance
