// Structural similarity on CUDA: what the ops' host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"

// Pixels lie one after the other; those of `image` and `gradient` are `stride` floats apart, of which `channels` count.
struct DeviceSsim {
  const float* image;
  const float* target;          // [H, W, C], or null with target_bytes
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null = all. Both images count as 0 elsewhere
  const float* upstream;        // dL/dmap [H, W, C], or null for 1
  const int64_t* tissue;        // tissue pixels: dL/dmap is divided by their number times channels; null: it is not
  float scale;                  // times upstream
  float* map;                   // [H, W, C] or null
  float* gradient;              // dL/dimage is added to it; null: none is wanted
  double* sums;                 // [blocks] or null: 1 - ssim summed over tissue
  int32_t height, width, channels, stride;

  int64_t blocks() const;
};
void ssim_on_device(const DeviceSsim& ssim, CudaScratch& scratch, cudaStream_t stream);
