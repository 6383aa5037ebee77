// CUDA's stream type and host/device qualifiers, for headers that are also compiled for the CPU.
#pragma once

using cudaStream_t = struct CUstream_st*;

#if defined(__CUDACC__)
#define GSPLAT_HOST_DEVICE static __host__ __device__ __forceinline__
#else
#define GSPLAT_HOST_DEVICE static inline __attribute__((always_inline))
#endif
