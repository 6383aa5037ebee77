// Covariance and precision matrices from rotations and scales.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::covariance {

// CPU kernels of the covariances and their gradients, for rows `begin` to `end` - 1.
struct Kernels {
  // Computes R S^p S^p R^T with p = 1, or p = -1 if `inverse`, as rows of 6 (upper triangle) or 9 floats.
  void (*forward)(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t begin, int64_t end);
  // Computes the gradients of quaternions and scales from those of covariances and precisions. Either gradient of the
  // outputs may be null.
  void (*backward)(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                   float* v_quats, float* v_scales, int64_t begin, int64_t end);
};

// Covariances of all rows and their gradients on CUDA; all pointers are device memory.
void covariance_forward(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t count,
                        cudaStream_t stream);
void covariance_backward(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                         float* v_quats, float* v_scales, int64_t count, cudaStream_t stream);

}  // namespace gsplat::covariance

GSPLAT_KERNELS(covariance, Kernels)
