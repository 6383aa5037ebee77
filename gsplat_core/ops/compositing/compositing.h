// Alpha compositing of depth-ordered splats, tile by tile, forward and backward: interface between the host code and
// the kernels of both devices.
//
// A tile is composited in windows of 16x16 pixels. On the CPU a window consists of blocks of one vector of pixels each,
// 4 wide: 4x4 with AVX-512, 4x2 with AVX2, else 4x1. A first pass finds the blocks that each splat's ellipse touches;
// the second pass blends only those. On CUDA a thread block of four warps processes a window; each warp has a quadrant
// of 8x8 pixels, two per thread (../blending).
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::compositing {

constexpr int kWindow = 16;            // pixels per side
constexpr int kMaxRecordChannels = 8;  // maximum number of channels stored in a CPU record
constexpr int kMoments = 6;            // sum over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha

struct Inputs {
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
  AlphaLimit alpha;

  constexpr int64_t tiles() const { return int64_t(images) * tile_width * tile_height; }
  constexpr int64_t windows() const {  // per tile
    const int64_t side = (tile_size + kWindow - 1) / kWindow;
    return side * side;
  }
};

// `last` is the position in flatten_ids of the last blended splat, or -1.
struct Pixels {
  float* colors;  // [images, height, width, channels]
  float* alphas;  // [images, height, width]
  int32_t* last;  // [images, height, width]
};

// Inputs of the backward pass: results of the forward pass, and dL/d(colours, alphas).
struct PictureGradient {
  const float* alphas;
  const int32_t* last;
  const float* v_colors;  // [images, height, width, channels]
  const float* v_alphas;  // [images, height, width]
};

struct InputGradients {
  float* means2d;      // [count, 2]
  float* conics;       // [count, 3]
  float* colors;       // [count, channels]
  float* opacities;    // [count]
  float* backgrounds;  // [images, channels] or null
  float* absolute;     // [count, 2] or null: sums of |dL/dmeans2d|
};

// CPU: one splat prepared for blending, on one cache line. log2(alpha) = a dx^2 + b dx dy + c dy^2 + l with (dx, dy)
// from the mean to the pixel. A splat with a non-finite value has l = -infinity, so that it reaches no pixel.
struct SplatRecord {
  float x, y, a, b, c, l;
  // Pixels where log2(alpha) exceeds this are skipped. For an indefinite conic it is l, the log2 of the opacity,
  // because sigma would be negative there. Otherwise it is infinity.
  float cap;
  float unused;
  float colors[kMaxRecordChannels];  // unused with more than kMaxRecordChannels channels
};

struct Splats : Inputs {
  const SplatRecord* records;
};

struct GradientRows {
  // Row of every instance: maps a position in flatten_ids to a row of `rows`, such that a splat's rows are contiguous.
  const int32_t* row_of;
  float* rows;  // [instances, row_size], cache-line aligned: moments, colours, then |dL/dx|, |dL/dy| with absgrad
  int64_t row_size;
  bool absgrad;
  float* v_backgrounds;  // [tiles, channels] partial sums, or null
};

struct Kernels {
  // Prepares the splats [begin, end) for blending, in `records`.
  void (*records)(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records);
  // Returns the floats of scratch memory (64-byte aligned) that one thread needs for either pass.
  int64_t (*scratch_floats)(int channels);
  void (*tile)(const Splats& in, int64_t tile, const Pixels& out, float* scratch);
  void (*tile_backward)(const Splats& in, int64_t tile, const PictureGradient& from, const GradientRows& out, float* scratch);
  // Sums the rows [first[i], first[i + 1]) of each splat and converts them to gradients, for splats [begin, end).
  void (*gather)(const Splats& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
                 const InputGradients& out);
};

// Alpha compositing on CUDA, forward and backward; all pointers are device memory.
void composite_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream);
void composite_backward_on_device(const Inputs& in, const PictureGradient& from, const InputGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream);

}  // namespace gsplat::compositing

GSPLAT_KERNELS(compositing, Kernels)
