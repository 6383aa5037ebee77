// Covariances on CUDA: what the op's host code asks of the kernels, as CovarianceKernels has them. All pointers are to device
// memory.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

void covariance_forward(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t count,
                        cudaStream_t stream);
void covariance_backward(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                         float* v_quats, float* v_scales, int64_t count, cudaStream_t stream);
