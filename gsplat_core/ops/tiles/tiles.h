// Which tiles a splat touches, and the lists of tiles' splats in depth order.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::tiles {

struct SplatBoxes {
  const float* means2d;      // [count, 2]
  const int32_t* radii;      // [count, 2]
  const float* depths;       // [count]
  const float* conics;       // [count, 3], or null: every tile of the box is touched
  const float* opacities;    // [count], null with conics
  const int32_t* image_ids;  // [count], or null: splat i is of image i / per_image
  int64_t count, per_image;
  int32_t images, tile_size, tile_width, tile_height;
};

// CPU: the tiles of one splat: a box, and inside it one bit per tile when the box is at most 8x8 (bit 8 row + column). A larger
// box is walked row by row again when it is needed. An invisible splat has no width.
struct TileSpan {
  uint16_t x, y, width, height;
  uint64_t touched;
};

struct Kernels {
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

// CUDA; every pointer is to device memory. Visible splats are sorted by depth first (32 bits, as many items as splats), then
// their tiles are written in that order and sorted by tile alone (as few bits as there are tiles). Radix sorts are stable, so
// ties in depth stay in the order of the splats.

// Splats in the order in which their tiles are written, and where each one's tiles start.
struct TileOrder {
  const uint32_t* splats;  // [count], by depth, those without tiles last; null: by index
  int64_t* starts;         // [count + 1]; the last is the number of instances
};

// Fills tile_counts [count] and puts the splats in order.
TileOrder order_splats(const SplatBoxes& in, bool by_depth, int32_t* tile_counts, CudaScratch& scratch, cudaStream_t stream);

// The instances (pairs of a tile and a splat), as two pairs of buffers to sort between; `current` says which of a pair holds the
// result. Where `count` is a capacity, unused entries have the key 0 and the splat -1, and every tile's key is one more: the sort
// puts what is unused in front of the first tile. Splats that do not fit in whole, the last ones in the order, are left out.
struct TileInstances {
  uint32_t* tiles[2];  // image * tiles + tile, and 1 where `count` is a capacity
  int32_t* splats[2];
  int64_t count;
  bool capacity;
  int current;
};
void emit_instances(const SplatBoxes& in, const TileOrder& order, TileInstances& instances, cudaStream_t stream);
void sort_by_tile(const SplatBoxes& in, TileInstances& instances, CudaScratch& scratch, cudaStream_t stream);

// offsets[t] = how many of the sorted instances are of tiles in front of t.
void encode_offsets(const TileInstances& instances, int64_t tiles, int32_t* offsets, cudaStream_t stream);
// The same for gsplat's 64-bit ids (image | tile | depth).
void encode_offsets(const int64_t* ids, int64_t count, int64_t images, int64_t tiles_per_image, int32_t* offsets,
                    cudaStream_t stream);
void make_ids(const SplatBoxes& in, const TileInstances& instances, int64_t* ids, cudaStream_t stream);

}  // namespace gsplat::tiles

GSPLAT_KERNELS(tiles, Kernels)
