#include "scalars.h"

namespace gsplat::scalars {
namespace {

__global__ void store(float* to, Scalars scalars) {
  if (int(threadIdx.x) < scalars.count) to[threadIdx.x] = scalars.values[threadIdx.x];
}

}  // namespace

void store_on_device(float* to, const Scalars& scalars, cudaStream_t stream) {
  store<<<1, kMostScalars, 0, stream>>>(to, scalars);
}

}  // namespace gsplat::scalars
