#include "frame_count_cuda.h"

namespace {

__global__ void count(const int32_t* status, int32_t* most, int64_t* step, float* fits) {
  const int32_t cut = status[kStatusCut] != 0;
  if (threadIdx.x == 0) {
    *step += 1 - cut;
    *fits = float(1 - cut);
  }
  const int i = int(threadIdx.x);
  most[i] = i == kStatusCut ? most[i] + cut : max(most[i], status[i]);
}

}  // namespace

void count_frame(const int32_t* status, int32_t* most, int64_t* step, float* fits, cudaStream_t stream) {
  count<<<1, kStatusWords, 0, stream>>>(status, most, step, fits);
}
