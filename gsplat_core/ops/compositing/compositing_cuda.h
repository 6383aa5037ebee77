// Compositing on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
//
// A block of four warps composites a window of 16x16 pixels (a tile, where tiles have that size), each warp a quadrant of 8x8
// with two pixels per thread. Splats are staged in shared memory as polynomials about the window's centre, with a note which
// parts of the window they reach; a warp then goes through those alone that reach its own part.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"

constexpr int kWindowSize = 16;  // pixels on a side

struct DeviceCompositing {
  const float* means2d;    // [count, 2]
  const float* conics;     // [count, 3]
  const float* colors;     // [count, channels]
  const float* opacities;  // [count]
  const int32_t* offsets;  // [images, tile_height, tile_width]
  const int32_t* flatten_ids;
  const float* backgrounds;  // [images, channels] or null
  const bool* masks;         // [images, tile_height, tile_width] or null
  int64_t count, instances;
  int32_t images, channels, width, height, tile_size, tile_width, tile_height;

  int64_t tiles() const { return int64_t(images) * tile_width * tile_height; }
  int64_t windows() const {  // of one tile
    const int64_t side = (tile_size + kWindowSize - 1) / kWindowSize;
    return side * side;
  }
};

// `last` is the last blended position of flatten_ids, -1 where there is none.
struct DevicePixels {
  float* colors;  // [images, height, width, channels]
  float* alphas;  // [images, height, width]
  int32_t* last;  // [images, height, width]
};
void composite_on_device(const DeviceCompositing& in, const DevicePixels& out, CudaScratch& scratch, cudaStream_t stream);

struct DeviceGradients {
  const float* alphas;    // of the forward pass
  const int32_t* last;    // of the forward pass
  const float* v_colors;  // [images, height, width, channels]
  const float* v_alphas;  // [images, height, width]
  float* v_means2d;       // [count, 2]
  float* v_conics;        // [count, 3]
  float* v_splat_colors;  // [count, channels]
  float* v_opacities;     // [count]
  float* v_backgrounds;   // [images, channels] or null
  float* v_absolute;      // [count, 2] or null
};
void composite_backward_on_device(const DeviceCompositing& in, const DeviceGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream);
