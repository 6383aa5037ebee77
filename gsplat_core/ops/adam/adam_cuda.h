// Adam on CUDA: what the op's host code asks of the kernel. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "adam.h"

// As AdamKernels::step. `skipped` must be 0 before; the number of rows left alone is added to it.
void adam_on_device(float* p, const float* g, float* m, float* v, int64_t rows, const AdamStep& step, int64_t* skipped,
                    cudaStream_t stream);
