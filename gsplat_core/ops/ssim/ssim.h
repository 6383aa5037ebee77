// Structural similarity (Wang et al. 2004) of interleaved images and its gradient, streamed over rows.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::ssim {

constexpr int kSsimRadius = 5;  // 11 taps
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
constexpr int kSsimMaxChannels = 32;
constexpr int kSsimStride = 2176;  // floats of one buffered row; 8.5 KiB, so that rows do not alias in the cache

// CPU.
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

struct Kernels {
  // Rows [row_begin, row_end) of one strip. No result depends on how rows are cut into bands.
  void (*band)(const SsimTask& task, int64_t strip, int64_t row_begin, int64_t row_end, float* scratch);
};
// Fills in the taps and runs all strips and rows on torch's threads.
void run_ssim(SsimTask& task);

// CUDA; every pointer is to device memory. Pixels lie one after the other; those of `image` and `gradient` are `stride` floats
// apart, of which `channels` count.
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
constexpr int64_t kSsimMostRows = 65535 * 32;  // a grid's second dimension
void ssim_on_device(const DeviceSsim& ssim, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::ssim

GSPLAT_KERNELS(ssim, Kernels)
