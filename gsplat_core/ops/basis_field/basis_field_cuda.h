// The basis field on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "basis_field.h"

struct DeviceBumps {
  const float *centers, *log_widths, *weights;
  const float* tau;  // [1]
  int64_t count, bumps;
  int32_t row;  // columns of deltas and gradients: kBasisChannels or kBasisPadded
};

struct DeviceBasisAdam {
  float *centers, *log_widths, *weights;
  float *m_centers, *m_log_widths, *m_weights, *v_centers, *v_log_widths, *v_weights;
  int32_t* steps;
  const float* tau;    // [1]
  const float* rates;  // [kBasisRates]
  int64_t count, bumps;
  int32_t row;
  float fresh1, fresh2;        // 1 - beta1, 1 - beta2, subtracted in double
  float log_beta1, log_beta2;  // natural logarithms
  float epsilon;
};

void basis_field_on_device(const DeviceBumps& field, float* deltas, cudaStream_t stream);
// Writes every element of the three gradients, zero where a bump is inactive.
void basis_field_backward_on_device(const DeviceBumps& field, const float* gradient, float* centers, float* log_widths,
                                    float* weights, cudaStream_t stream);
void basis_field_adam_on_device(const DeviceBasisAdam& field, const float* gradient, cudaStream_t stream);
