// Spherical harmonics on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "spherical_harmonics.h"

// `rows` rows of `sets` directions; the rows share the coefficients of their sets.
void harmonics_forward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, float* colors, cudaStream_t stream);
// `v_dirs` may be null; `v_coeffs` is written whole, summed over the rows in their order.
void harmonics_backward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, const float* v_colors, float* v_dirs,
                        float* v_coeffs, cudaStream_t stream);
