// What this library was built for, and whether the GPU at hand is among it: read through ctypes by gsplat_core/ops/native.py, so
// that the answer is the library's own and not that of a file beside it.
#include <cuda_runtime.h>

#include "cuda_resources.h"

#define TEXT_OF(...) #__VA_ARGS__
#define TEXT(...) TEXT_OF(__VA_ARGS__)
#define VISIBLE extern "C" __attribute__((visibility("default")))

namespace {
__global__ void probe() {}
}  // namespace

// The compiler's version, a semicolon, and the architectures that it compiled for as it names them: "13.0;800,900".
VISIBLE const char* gsplat_core_cuda_build() {
  return TEXT(__CUDACC_VER_MAJOR__) "." TEXT(__CUDACC_VER_MINOR__) ";" TEXT(__CUDA_ARCH_LIST__);
}

// Null if the current device can run this library's kernels, otherwise what CUDA says.
VISIBLE const char* gsplat_core_cuda_refusal() {
  cudaFuncAttributes attributes;
  const cudaError_t error = cudaFuncGetAttributes(&attributes, probe);
  cudaGetLastError();  // or the next call of anybody would report it
  return error == cudaSuccess ? nullptr : cudaGetErrorString(error);
}

// How many streams and events this library owns at the moment.
VISIBLE int gsplat_core_cuda_resources() { return gsplat::cuda_resources_alive.load(); }
