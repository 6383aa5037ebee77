// Programmatic dependent launch: blocks of a kernel are scheduled while the last blocks of the preceding kernel still
// run, and wait for its results on the device. Needs compute capability 9.0; on earlier GPUs it is an ordinary launch.
#pragma once

#include <cuda_runtime.h>

#include <type_traits>

#include "cuda_check.h"

namespace {

// Wait until the results of the preceding kernels are visible. Every thread of a kernel started by `launch_dependent`
// must call it.
__device__ inline void wait_for_preceding_kernel() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Allow the next kernel to be scheduled once every block of this kernel has called this or exited.
__device__ inline void allow_dependent_launch() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;");
#endif
}

template <class... Parameters>
void launch_dependent(void (*kernel)(Parameters...), unsigned blocks, int threads, cudaStream_t stream, size_t shared_bytes,
                      std::type_identity_t<Parameters>... parameters) {
  cudaFuncAttributes code = {};
  check_cuda(cudaFuncGetAttributes(&code, kernel), "asking for a kernel's attributes");
  cudaLaunchAttribute attribute = {};
  attribute.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  attribute.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config = {};
  config.gridDim = dim3(blocks);
  config.blockDim = dim3(unsigned(threads));
  config.dynamicSmemBytes = shared_bytes;
  config.stream = stream;
  config.attrs = &attribute;
  config.numAttrs = code.ptxVersion >= 90 ? 1 : 0;  // code compiled for earlier GPUs does not contain the wait
  check_cuda(cudaLaunchKernelEx(&config, kernel, parameters...), "launching a dependent kernel");
}

}  // namespace
