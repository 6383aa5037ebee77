// A few numbers from the host to device memory, in the arguments of a launch: no copy that could wait, or be read too late.
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
