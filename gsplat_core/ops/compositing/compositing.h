// Alpha compositing of depth-ordered splats, tile by tile, forward and backward: what the host code and the kernels of both
// devices share.
//
// A tile is composited in windows of 16x16 pixels. CPU: a window in blocks of one vector of pixels each, 4 wide: 4x4 with
// AVX-512, 4x2 with AVX2. A first pass finds for every splat the blocks that its ellipse touches; the second blends only those.
// CUDA: a thread block of four warps has a window, each warp a quadrant of 8x8 with two pixels per thread (../blending).
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::compositing {

constexpr int kWindow = 16;            // pixels on a side
constexpr int kMaxRecordChannels = 8;  // channels that a CPU record has memory for
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
  constexpr int64_t windows() const {  // of one tile
    const int64_t side = (tile_size + kWindow - 1) / kWindow;
    return side * side;
  }
};

// `last` is the last blended position of flatten_ids, -1 where there is none.
struct Pixels {
  float* colors;  // [images, height, width, channels]
  float* alphas;  // [images, height, width]
  int32_t* last;  // [images, height, width]
};

// What the backward pass gets: results of the forward pass, and dL/d(colours, alphas).
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
  float* absolute;     // [count, 2]: sums of |dL/dmeans2d|; or null
};

// CPU: one splat, ready to blend, on one cache line. log2(alpha) = a dx^2 + b dx dy + c dy^2 + l with dx, dy from the mean to the
// pixel. A splat with a value that is not finite has l = -infinity, so that it reaches no pixel.
struct SplatRecord {
  float x, y, a, b, c, l;
  // log2(alpha) beyond this is skipped: l where the conic is indefinite (sigma would be negative), else infinity.
  float cap;
  float unused;
  float colors[kMaxRecordChannels];  // unless there are more channels
};

struct Splats : Inputs {
  const SplatRecord* records;
};

struct GradientRows {
  // Where the row of every instance goes: position of flatten_ids -> row of `rows`, so that a splat's rows are contiguous.
  const int32_t* row_of;
  float* rows;  // [instances, row_size]: moments, colours, then |dL/dx|, |dL/dy| with absgrad; on cache lines
  int64_t row_size;
  bool absgrad;
  float* v_backgrounds;  // [tiles, channels] partial sums, or null
};

struct Kernels {
  // Records of splats [begin, end).
  void (*records)(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records);
  // Floats of scratch memory (64-byte aligned) that one thread needs for either pass.
  int64_t (*scratch_floats)(int channels);
  void (*tile)(const Splats& in, int64_t tile, const Pixels& out, float* scratch);
  void (*tile_backward)(const Splats& in, int64_t tile, const PictureGradient& from, const GradientRows& out, float* scratch);
  // Sums a splat's rows [first[i], first[i + 1]) and turns them into gradients, for splats [begin, end).
  void (*gather)(const Splats& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
                 const InputGradients& out);
};

// CUDA: all pointers are device memory.
void composite_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream);
void composite_backward_on_device(const Inputs& in, const PictureGradient& from, const InputGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream);

}  // namespace gsplat::compositing

GSPLAT_KERNELS(compositing, Kernels)
