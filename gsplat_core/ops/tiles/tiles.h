// Which tiles a splat touches, and the lists of tiles' splats in depth order.
#pragma once

#include <cstdint>

#include "isa.h"

// The tiles of one splat: a box, and inside it one bit per tile when the box is at most 8x8 (bit 8 row + column). A larger box
// is walked row by row again when it is needed. An invisible splat has no width.
struct TileSpan {
  uint16_t x, y, width, height;
  uint64_t touched;
};

struct SplatBoxes {
  const float* means2d;      // [count, 2]
  const int32_t* radii;      // [count, 2]
  const float* depths;       // [count]
  const float* conics;       // [count, 3], or null: every tile of the box is touched
  const float* opacities;    // [count], null with conics
  const int32_t* image_ids;  // [count], or null: splat i is of image i / per_image
  int64_t per_image;
  int32_t tile_size, tile_width, tile_height;
};

struct TilesKernels {
  // Spans and tile counts of splats [begin, end).
  void (*spans)(const SplatBoxes& in, int64_t begin, int64_t end, TileSpan* spans, int32_t* tile_counts);
  // Adds one to the counter of every tile that the splats order[begin..end) touch.
  void (*count)(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end,
                int32_t* counters);
  // Writes each of those splats at its tile's cursor, which moves on. With `keys`, also image|tile|depth (gsplat's isect_ids).
  void (*emit)(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end, int32_t* cursors,
               int32_t* flatten_ids, int64_t* keys);
  // Writes the tiles of one splat, row by row, from `at` on.
  void (*emit_one)(const SplatBoxes& in, const TileSpan& span, int64_t splat, int64_t at, int32_t* flatten_ids, int64_t* keys);
};
GSPLAT_DECLARE_KERNELS(TilesKernels, tiles_kernels)
