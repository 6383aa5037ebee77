// The image loss on CUDA: what the ops' host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"

// Pixels lie one after the other; those of `image` and `v_image` are `stride` floats apart, of which `channels` are compared.
struct DeviceImageLoss {
  const float* image;
  const float* target;          // [H, W, channels], or null with target_bytes
  const uint8_t* target_bytes;  // [H, W, channels], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null = all
  // Depth: either a plane, or the channel behind the colours, not divided by alpha yet. Null: no depth.
  const float* depth;   // [H, W]
  const float* alphas;  // [H, W], of the frame path
  const float* target_depth;
  float ssim_weight, depth_weight;
  int32_t height, width, channels, stride;

  float* v_image;
  float* v_depth;   // [H, W], with depth
  float* v_alphas;  // [H, W], with alphas
  float* loss;      // [1]
  float* terms;     // [3]: L1, 1 - SSIM, inverse-depth L1

  int64_t pixels;  // height times width
};
void image_loss_on_device(const DeviceImageLoss& loss, CudaScratch& scratch, cudaStream_t stream);
