// Launching a kernel of the frame path behind another: its blocks come to the multiprocessors while the other's last ones are
// still at work, and wait there (programmatic dependent launch, compute capability 9.0 and later; elsewhere an ordinary launch).
#pragma once

#include <cuda_runtime.h>

#include <type_traits>

namespace {

// What the kernels in front wrote can be read behind this. Every thread of a kernel that is launched behind another calls it.
__device__ inline void wait_for_kernel_in_front() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// The kernel behind may come as soon as all blocks of this one are there.
__device__ inline void let_kernel_behind_come() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.launch_dependents;");
#endif
}

template <class... Parameters>
void launch_behind(void (*kernel)(Parameters...), unsigned blocks, int threads, cudaStream_t stream, size_t shared_bytes,
                   std::type_identity_t<Parameters>... parameters) {
  cudaFuncAttributes code = {};
  cudaFuncGetAttributes(&code, kernel);
  cudaLaunchAttribute attribute = {};
  attribute.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  attribute.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config = {};
  config.gridDim = dim3(blocks);
  config.blockDim = dim3(unsigned(threads));
  config.dynamicSmemBytes = shared_bytes;
  config.stream = stream;
  config.attrs = &attribute;
  config.numAttrs = code.ptxVersion >= 90 ? 1 : 0;     // code for earlier ones does not wait by itself
  cudaLaunchKernelEx(&config, kernel, parameters...);  // an error is found by cudaGetLastError
}

}  // namespace
