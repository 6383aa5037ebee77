// Adam on CUDA: what the op's host code asks of the kernel. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "adam.h"

// As AdamKernels::step. `skipped` must be 0 before; the number of rows left alone is added to it.
void adam_on_device(float* p, const float* g, float* m, float* v, int64_t rows, const AdamStep& step, int64_t* skipped,
                    cudaStream_t stream);

// What of AdamStep is read on the device.
struct AdamAt {
  const float* rate;            // [1]: the learning rate
  const int64_t* step;          // [1]: counts from 1
  double log_beta1, log_beta2;  // natural logarithms
  float fresh1, fresh2, epsilon;
  int64_t row_size;
};

// The same with `skipped` as it is, and added to.
void adam_at_on_device(float* p, const float* g, float* m, float* v, int64_t rows, const AdamAt& at, int64_t* skipped,
                       cudaStream_t stream);
