// Structural similarity (Wang et al. 2004) of interleaved images and its gradient, streamed over rows.
#pragma once

#include <cstdint>

#include "isa.h"

constexpr int kSsimRadius = 5;  // 11 taps
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
constexpr int kSsimMaxChannels = 32;
constexpr int kSsimStride = 2176;  // floats of one buffered row; 8.5 KiB, so that rows do not alias in the cache

struct SsimTask {
  const float* image;           // [H, W, C]
  const float* target;          // [H, W, C], or null with target_bytes
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null = all. Both images count as 0 elsewhere
  const float* upstream;        // dL/dmap [H, W, C], or null for 1
  float scale;                  // times upstream
  float* map;                   // [H, W, C] or null
  float* gradient;              // [H, W, C] or null; dL/dimage is added to it
  double* sums;                 // [H, strips] or null: 1 - ssim summed over tissue
  int64_t height, width;
  int channels;
  float taps[kSsimTaps];
};

// The image is processed in strips of columns that fit the cache; a strip needs a halo of two radii on each side.
inline int64_t ssim_strip_px(int channels) { return (kSsimStride - 64) / channels - 4 * kSsimRadius; }
inline int64_t ssim_strips(int64_t width, int channels) {
  return (width + ssim_strip_px(channels) - 1) / ssim_strip_px(channels);
}

// Rows kept by one thread: rings of 11 rows for image, target, tissue and the three blurred derivatives, and 9 single rows.
constexpr int kSsimScratchFloats = (6 * kSsimTaps + 9) * kSsimStride;

struct SsimKernels {
  // Rows [row_begin, row_end) of one strip. No result depends on how rows are cut into bands.
  void (*band)(const SsimTask& task, int64_t strip, int64_t row_begin, int64_t row_end, float* scratch);
};
GSPLAT_DECLARE_KERNELS(SsimKernels, ssim_kernels)

// Fills in the taps and runs all strips and rows on torch's threads.
void run_ssim(SsimTask& task);
