// Writes a few numbers from the host to device memory as kernel arguments. A copy could block, or read the host memory
// after it has changed.
#pragma once

#include "cuda_stream.h"

namespace gsplat::scalars {

constexpr int kMostScalars = 64;

struct Scalars {
  float values[kMostScalars];
  int count;
};
void store_on_device(float* to, const Scalars& scalars, cudaStream_t stream);

}  // namespace gsplat::scalars
