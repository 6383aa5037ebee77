// Structural similarity (Wang et al. 2004) of interleaved images, and its gradient. The CPU version streams over rows.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::ssim {

constexpr int kSsimRadius = 5;  // 11 taps
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
constexpr int kSsimMaxChannels = 32;
constexpr int kSsimStride = 2176;  // floats per buffered row; 8.5 KiB, so that rows do not alias in the cache

// Task of the CPU kernel.
struct SsimTask {
  const float* image;           // [H, W, C]
  const float* target;          // [H, W, C]; null if target_bytes is set
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null: all pixels. Both images count as 0 elsewhere
  const float* upstream;        // dL/dmap [H, W, C]; null: 1
  float scale;                  // factor of upstream
  float* map;                   // [H, W, C] or null
  float* gradient;              // [H, W, C] or null; dL/dimage is added to it
  double* sums;                 // [H, strips] or null: 1 - ssim summed over tissue
  int64_t height, width;
  int64_t border;  // pixels this close to the edge count neither in `sums` nor, without `upstream`, in the gradient
  int channels;
  float taps[kSsimTaps];
};

// The image is processed in column strips that fit the cache. A strip has a halo of two radii on each side.
inline int64_t ssim_strip_px(int channels) { return (kSsimStride - 64) / channels - 4 * kSsimRadius; }
inline int64_t ssim_strips(int64_t width, int channels) {
  return (width + ssim_strip_px(channels) - 1) / ssim_strip_px(channels);
}

// Rows that one thread buffers: rings of 11 rows for image, target, tissue and the three blurred derivatives, and 9
// single rows.
constexpr int kSsimScratchFloats = (6 * kSsimTaps + 9) * kSsimStride;

struct Kernels {
  // Processes rows [row_begin, row_end) of one strip. Results do not depend on the partition into bands.
  void (*band)(const SsimTask& task, int64_t strip, int64_t row_begin, int64_t row_end, float* scratch);
};
// Compute the window's weights (`taps`), then all strips and rows on torch's threads.
void run_ssim(SsimTask& task);

// Arguments of SSIM on CUDA; all pointers are device memory. Pixels of `image` and `gradient` are `stride` floats
// apart; the first `channels` floats are compared.
struct DeviceSsim {
  const float* image;
  const float* target;          // [H, W, C]; null if target_bytes is set
  const uint8_t* target_bytes;  // [H, W, C], value / 255
  const uint8_t* mask;          // [H, W], non-zero = tissue; null: all pixels. Both images count as 0 elsewhere
  const float* upstream;        // dL/dmap [H, W, C]; null: 1
  const int64_t* tissue;        // number of tissue pixels; dL/dmap is divided by it times channels. null: no division
  const float* factor;          // one more factor of upstream; null: 1
  float scale;                  // factor of upstream
  float* map;                   // [H, W, C] or null
  float* gradient;              // dL/dimage is added to it; null: not requested
  double* sums;                 // [blocks] or null: 1 - ssim summed over tissue
  int32_t height, width, channels, stride;
  int32_t border;  // pixels this close to the edge count neither in `sums` nor in the gradient

  int64_t blocks() const;
};
constexpr int64_t kSsimMostRows = 65535 * 32;  // maximum grid size in the second dimension, times the tile height
void ssim_on_device(const DeviceSsim& ssim, CudaScratch& scratch, cudaStream_t stream);
// Compute the mean similarity without a mask. `values` is the number of compared values: channels times pixels outside of
// the border.
void ssim_mean_on_device(DeviceSsim ssim, double values, float* mean, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::ssim

GSPLAT_KERNELS(ssim, Kernels)
