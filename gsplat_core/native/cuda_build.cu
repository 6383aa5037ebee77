// CUDA architectures this library was compiled for, and a check that the current GPU is among them.
// gsplat_core/ops/native.py reads both through ctypes from the loaded library, not from build metadata.
#include <cuda_runtime.h>

#include "cuda_resources.h"

#define TEXT_OF(...) #__VA_ARGS__
#define TEXT(...) TEXT_OF(__VA_ARGS__)
#define VISIBLE extern "C" __attribute__((visibility("default")))

namespace {
__global__ void probe() {}
}  // namespace

// Return the compiler version and the compiled architectures, in the compiler's notation: "13.0;800,900".
VISIBLE const char* gsplat_core_cuda_build() {
  return TEXT(__CUDACC_VER_MAJOR__) "." TEXT(__CUDACC_VER_MINOR__) ";" TEXT(__CUDA_ARCH_LIST__);
}

// Return null if the current device can run this library's kernels, otherwise CUDA's error message.
VISIBLE const char* gsplat_core_cuda_refusal() {
  cudaFuncAttributes attributes;
  const cudaError_t error = cudaFuncGetAttributes(&attributes, probe);
  cudaGetLastError();  // clear the error; otherwise the next CUDA call in the process would report it
  return error == cudaSuccess ? nullptr : cudaGetErrorString(error);
}

// Return the number of CUDA streams and events that this library currently owns.
VISIBLE int gsplat_core_cuda_resources() { return gsplat::cuda_resources_alive.load(); }
