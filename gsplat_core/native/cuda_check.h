// Checks of CUDA return codes; the exception names the operation and CUDA's error. Uses no torch headers, so that
// device code can include it.
#pragma once

#include <cuda_runtime.h>

#include "checks.h"

inline void check_cuda(cudaError_t error, const char* what) {
  gsplat::check(error == cudaSuccess, what, " failed on the GPU: ", cudaGetErrorString(error), " (", cudaGetErrorName(error),
                ")");
}
