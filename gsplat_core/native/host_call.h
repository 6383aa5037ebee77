// What the host file of an op, <op>_host.cpp, is written against. It is compiled twice: into the CPU library, and with
// GSPLAT_CUDA into the CUDA library. `Call` is one call of the op on that device; GSPLAT_DEVICE is torch's dispatch key.
#pragma once

#if defined(GSPLAT_CUDA)
#include "cuda_call.h"
#define GSPLAT_DEVICE CUDA
using Call = CudaCall;
#else
#include "cpu_call.h"
#define GSPLAT_DEVICE CPU
using Call = CpuCall;
#endif
