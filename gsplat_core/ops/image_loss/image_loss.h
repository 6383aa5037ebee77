// The cheap terms of the image loss, row by row: masked L1 and inverse-depth L1, each with its gradient.
#pragma once

#include <cstdint>

#include "isa.h"

struct L1Task {
  const float* image;           // [H, W, C]
  const float* target;          // [H, W, C], or null with target_bytes
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null = all
  float* gradient;              // [H, W, C], written
  float scale;                  // dL/d|difference|
  double* sums;                 // [H]: |difference| summed over tissue
  int64_t width;
  int channels;
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

struct ImageLossKernels {
  void (*l1_rows)(const L1Task& task, int64_t row_begin, int64_t row_end);
  void (*count_depth_rows)(const DepthTask& task, int64_t row_begin, int64_t row_end);
  void (*depth_rows)(const DepthTask& task, int64_t row_begin, int64_t row_end);
  int64_t (*count_tissue)(const uint8_t* mask, int64_t pixels);
};
GSPLAT_DECLARE_KERNELS(ImageLossKernels, image_loss_kernels)
