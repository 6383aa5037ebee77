// CUDA's stream type and what functions for host and device are marked with, for headers that are compiled for the CPU too.
#pragma once

using cudaStream_t = struct CUstream_st*;

#if defined(__CUDACC__)
#define GSPLAT_HOST_DEVICE static __host__ __device__ __forceinline__
#else
#define GSPLAT_HOST_DEVICE static inline __attribute__((always_inline))
#endif
