// Alpha compositing of depth-ordered splats, tile by tile, forward and backward.
//
// Inside a tile the work goes in windows of 16x16 pixels, and a window in blocks of one vector of pixels each, 4 wide: 4x4 with
// AVX-512, 4x2 with AVX2. A first pass finds for every splat the blocks that its ellipse touches; the second blends only those.
#pragma once

#include <cstdint>

#include "isa.h"

// One splat, ready to blend, on one cache line. log2(alpha) = a dx^2 + b dx dy + c dy^2 + l with dx, dy from the mean to the
// pixel. A splat with a value that is not finite has l = -infinity, so that it reaches no pixel.
struct SplatRecord {
  float x, y, a, b, c, l;
  // log2(alpha) beyond this is skipped: l where the conic is indefinite (sigma would be negative), else infinity.
  float cap;
  float unused;
  float colors[8];  // where there are at most 8 channels
};

constexpr int kWindow = 16;       // pixels on a side
constexpr int kMostRecorded = 8;  // channels that a record has room for
constexpr int kMoments = 6;       // sum over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = alpha dL/dalpha

struct Compositing {
  const SplatRecord* records;
  const float* colors;     // [count, channels]
  const float* means2d;    // [count, 2]
  const float* conics;     // [count, 3]
  const float* opacities;  // [count]
  int32_t channels;
  const int32_t* offsets;  // [images, tile_height, tile_width]
  const int32_t* flatten_ids;
  int64_t instances;
  int32_t images, width, height, tile_size, tile_width, tile_height;
  const float* backgrounds;  // [images, channels] or null
  const bool* masks;         // [images, tile_height, tile_width] or null
};

// Results of the forward pass. `last` is the last blended position of flatten_ids, -1 where there is none.
struct CompositedPixels {
  float* colors;  // [images, height, width, channels]
  float* alphas;  // [images, height, width]
  int32_t* last;  // [images, height, width]
};

struct CompositingGradients {
  const float* alphas;    // of the forward pass
  const int32_t* last;    // of the forward pass
  const float* v_colors;  // [images, height, width, channels]
  const float* v_alphas;  // [images, height, width]
  bool absgrad;
  // Where the gradient of every instance goes: position of flatten_ids -> row of `rows`, so that a splat's rows are neighbours.
  const int32_t* slots;
  float* rows;  // [instances, row_size]: moments, colours, then |dL/dx|, |dL/dy| with absgrad; on cache lines
  int64_t row_size;
  float* v_backgrounds;  // [tiles, channels] partial sums, or null
};

struct CompositingKernels {
  // Records of splats [begin, end).
  void (*records)(const Compositing& in, int64_t begin, int64_t end, SplatRecord* records);
  // Floats of scratch memory (64-byte aligned) that one thread needs for either pass.
  int64_t (*scratch_floats)(int channels);
  void (*tile)(const Compositing& in, int64_t tile, const CompositedPixels& out, float* scratch);
  void (*tile_backward)(const Compositing& in, int64_t tile, const CompositingGradients& out, float* scratch);
  // Sums a splat's rows [first[i], first[i + 1]) and turns them into gradients, for splats [begin, end).
  void (*gather)(const Compositing& in, const CompositingGradients& from, const int32_t* first, int64_t begin, int64_t end,
                 float* v_means2d, float* v_conics, float* v_colors, float* v_opacities, float* v_means2d_abs);
};
GSPLAT_DECLARE_KERNELS(CompositingKernels, compositing_kernels)
