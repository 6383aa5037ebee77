// Tile intersection: the tiles that each splat touches, and each tile's list of splats in depth order.
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
  const float* conics;       // [count, 3]; null: a splat touches every tile of its box
  const float* opacities;    // [count]; null without conics
  const int32_t* image_ids;  // [count]; null: splat i belongs to image i / per_image
  int64_t count, per_image;
  int32_t images, tile_size, tile_width, tile_height;
};

// CPU: the tiles of one splat. It stores a box, and one bit per tile if the box is at most 8x8 (bit 8 row + column). A
// larger box is evaluated row by row when its tiles are needed. An invisible splat has width 0.
struct TileSpan {
  uint16_t x, y, width, height;
  uint64_t touched;
};

struct Kernels {
  // Computes spans and tile counts of splats [begin, end).
  void (*spans)(const SplatBoxes& in, int64_t begin, int64_t end, TileSpan* spans, int32_t* tile_counts);
  // Increments the counter of every tile that the splats order[begin..end) touch.
  void (*count)(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end,
                int32_t* counters);
  // Writes each of the splats order[begin..end) at the cursor of every tile it touches, and advances the cursor. With
  // `keys`, also writes image|tile|depth (gsplat's isect_ids).
  void (*emit)(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end, int32_t* cursors,
               int32_t* flatten_ids, int64_t* keys);
  // Writes the tiles of one splat row by row, starting at position `at`.
  void (*emit_one)(const SplatBoxes& in, const TileSpan& span, int64_t splat, int64_t at, int32_t* flatten_ids, int64_t* keys);
};

// Tile lists on CUDA; all pointers are device memory. Visible splats are first sorted by depth (32 bits, one item per
// splat). Then their tiles are written in that order and sorted by tile only (as few bits as the number of tiles
// requires). Radix sorts are stable, so ties in depth stay in splat order.

// The order in which the splats' tiles are written, and the start of each splat's tiles.
struct TileOrder {
  const uint32_t* splats;  // [count] by depth, splats without tiles last; null: by index
  int64_t* starts;         // [count + 1]; the last is the number of instances
};

// Fill tile_counts [count] and order the splats.
TileOrder order_splats(const SplatBoxes& in, bool by_depth, int32_t* tile_counts, CudaScratch& scratch, cudaStream_t stream);

// The instances (pairs of a tile and a splat) in two pairs of buffers for sorting; `current` selects the buffer with
// the result. If `count` is a capacity, unused entries have key 0 and splat -1, and every tile's key is increased by
// one, so that the sort moves unused entries to the front. Splats that do not fit completely, the last in the order,
// are dropped.
struct TileInstances {
  uint32_t* tiles[2];  // image * tiles + tile, plus 1 if `count` is a capacity
  int32_t* splats[2];
  int64_t count;
  bool capacity;
  int current;
};
void emit_instances(const SplatBoxes& in, const TileOrder& order, TileInstances& instances, cudaStream_t stream);
void sort_by_tile(const SplatBoxes& in, TileInstances& instances, CudaScratch& scratch, cudaStream_t stream);

// Compute offsets[t], the number of sorted instances in tiles before t.
void encode_offsets(const TileInstances& instances, int64_t tiles, int32_t* offsets, cudaStream_t stream);
// Compute the same offsets from gsplat's sorted 64-bit ids (image | tile | depth).
void encode_offsets(const int64_t* ids, int64_t count, int64_t images, int64_t tiles_per_image, int32_t* offsets,
                    cudaStream_t stream);
void make_ids(const SplatBoxes& in, const TileInstances& instances, int64_t* ids, cudaStream_t stream);

}  // namespace gsplat::tiles

GSPLAT_KERNELS(tiles, Kernels)
