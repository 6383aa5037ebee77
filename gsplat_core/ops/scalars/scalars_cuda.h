// A few numbers from the host to device memory, in the arguments of a launch: no copy that could wait, or read too late.
#pragma once

#include <cuda_runtime.h>

constexpr int kMostScalars = 64;

struct DeviceScalars {
  float values[kMostScalars];
  int count;
};
void store_on_device(float* to, const DeviceScalars& scalars, cudaStream_t stream);
