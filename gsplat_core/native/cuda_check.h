// CUDA's return codes: what failed, and what CUDA says. Without torch's headers, for device code too.
#pragma once

#include <cuda_runtime.h>

#include "checks.h"

inline void check_cuda(cudaError_t error, const char* what) {
  gsplat::check(error == cudaSuccess, what, " failed on the GPU: ", cudaGetErrorString(error), " (", cudaGetErrorName(error),
                ")");
}
