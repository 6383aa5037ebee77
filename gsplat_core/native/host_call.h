// Common header of an op's host file, <op>_host.cpp. Each host file is compiled twice: for the CPU library, and with
// GSPLAT_CUDA for the CUDA library. `Call` is the type of an op call on that device; GSPLAT_DEVICE is torch's dispatch
// key.
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
