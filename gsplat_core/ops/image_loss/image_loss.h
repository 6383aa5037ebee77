// Image loss and its gradients: masked L1 or squared error, structural similarity (../ssim) and inverse-depth L1.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::image_loss {

// The squared error of a difference d is d² / (2 kSteepAsL1): its slope equals that of |d| at d = kSteepAsL1. This is
// about the residual of a trained image, so the same learning rates and Adam epsilon suit both losses.
constexpr float kSteepAsL1 = 0.01f;

// CPU tasks for colours and inverse depth, processed row by row.
struct ColourTask {
  const float* image;           // [H, W, C]
  const float* target;          // [H, W, C]; null if target_bytes is set
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null: all pixels
  float* gradient;              // [H, W, C], output
  float scale;                  // factor of the difference's sign in the gradient, or of the difference itself if `squared`
  double* sums;                 // [H]: |difference| or its square, summed over tissue
  int64_t width;
  int channels;
  bool squared;
};

struct DepthTask {
  const float* depth;   // [H, W]; a pixel counts if depth, target and mask are positive
  const float* target;  // [H, W]
  const uint8_t* mask;  // [H, W] or null
  float* gradient;      // [H, W], output
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

// CUDA task for all terms; every pointer is device memory. Pixels of `image` and `v_image` are `stride` floats apart: the
// `channels` colours, then the depth if `alphas` is given, then unused floats.
struct DeviceImageLoss {
  const float* image;
  const float* target;          // [H, W, channels]; null if target_bytes is set
  const uint8_t* target_bytes;  // [H, W, channels], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null: all pixels
  // Rendered depth: either a plane, or the channel after the colours, which is not yet divided by alpha. If `depth` and
  // `alphas` are both null, there is no depth term.
  const float* depth;   // [H, W]
  const float* alphas;  // [H, W], for images of render_frame
  const float* target_depth;
  float ssim_weight, depth_weight;
  int32_t height, width, channels, stride;
  bool squared;  // squared error instead of L1

  float* v_image;
  float* v_depth;   // [H, W], if depth is given
  float* v_alphas;  // [H, W], if alphas are given
  float* loss;      // [1]
  float* terms;     // [3]: L1 or squared error, 1 - SSIM, inverse-depth L1

  int64_t pixels;  // height * width
};
void image_loss_on_device(const DeviceImageLoss& loss, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::image_loss

GSPLAT_KERNELS(image_loss, Kernels)
