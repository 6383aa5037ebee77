// Factorised HexPlane inference at one time: cached space features times three lines per level, then an MLP with ReLU between
// layers. A block of Gaussians goes through all layers while it is in the first-level cache.
#pragma once

#include <cstdint>

#include "isa.h"

constexpr int kMaxLevels = 16;
constexpr int kMaxLayers = 66;
constexpr int64_t kBlockRows = 48;  // a multiple of the rows of every micro-kernel

struct DecodeLevel {
  const float* space;     // [N, C]
  const float* lines[3];  // [U, C] at the time wanted; null when `space` already holds the features
  int32_t widths[3];      // U
  int64_t channels;
};

struct DecodeLayer {
  const float* weights;  // transposed and padded with zeros: [inputs, padded outputs]
  const float* bias;     // [padded outputs]
  int64_t inputs, padded_outputs;
};

struct Decode {
  DecodeLevel levels[kMaxLevels];
  DecodeLayer layers[kMaxLayers];
  int level_count, layer_count;
  const float* coordinates;  // [N, 4] in [-1, 1]
  float* outputs;            // [N, output_count]
  int64_t output_count;
  int64_t stride;  // floats per row of a buffer: at least the features and every layer's padded outputs
};

struct DecodeKernels {
  int lanes;  // outputs are padded to a multiple of this
  // `buffer` holds 2 * kBlockRows * stride floats.
  void (*decode)(const Decode& d, float* buffer, int64_t begin, int64_t end);
};
GSPLAT_DECLARE_KERNELS(DecodeKernels, decode_kernels)
