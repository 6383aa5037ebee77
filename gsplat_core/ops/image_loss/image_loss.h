// The image loss: masked L1 or squared error, structural similarity (../ssim) and inverse-depth L1, with their gradients.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::image_loss {

// The squared error of a difference d is d² / (2 kSteepAsL1): as steep as |d| at d = kSteepAsL1. That is about what a trained
// picture is off by, so learning rates, and Adam's epsilon beside the gradient, suit both.
constexpr float kSteepAsL1 = 0.01f;

// CPU: colours and inverse depth, row by row.
struct ColourTask {
  const float* image;           // [H, W, C]
  const float* target;          // [H, W, C], or null with target_bytes
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null = all
  float* gradient;              // [H, W, C], written
  float scale;                  // what the gradient has of a difference's sign, or with `squared` of the difference
  double* sums;                 // [H]: |difference|, or its square, summed over tissue
  int64_t width;
  int channels;
  bool squared;
};

struct DepthTask {
  const float* depth;   // [H, W]; counts where it, the target and the mask are positive
  const float* target;  // [H, W]
  const uint8_t* mask;  // [H, W] or null
  float* gradient;      // [H, W], written
  float scale;          // dL/d|difference|
  double* sums;         // [H]: |1/depth - 1/target| summed over valid pixels
  int64_t* counts;      // [H]: valid pixels
  int64_t width;
};

struct Kernels {
  void (*colour_rows)(const ColourTask& task, int64_t row_begin, int64_t row_end);
  void (*count_depth_rows)(const DepthTask& task, int64_t row_begin, int64_t row_end);
  void (*depth_rows)(const DepthTask& task, int64_t row_begin, int64_t row_end);
  int64_t (*count_tissue)(const uint8_t* mask, int64_t pixels);
};

// CUDA: all terms; every pointer is to device memory. Pixels lie one after the other; those of `image` and `v_image` are `stride`
// floats apart, of which `channels` are compared.
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
  bool squared;  // the squared error in place of L1

  float* v_image;
  float* v_depth;   // [H, W], with depth
  float* v_alphas;  // [H, W], with alphas
  float* loss;      // [1]
  float* terms;     // [3]: L1 or squared error, 1 - SSIM, inverse-depth L1

  int64_t pixels;  // height times width
};
void image_loss_on_device(const DeviceImageLoss& loss, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::image_loss

GSPLAT_KERNELS(image_loss, Kernels)
