// Tile lists on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
//
// Visible splats are sorted by depth first (32 bits, as many items as splats), then their tiles are written in that order and
// sorted by tile alone (as few bits as there are tiles). Radix sorts are stable, so ties in depth stay in the order of the
// splats.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"

struct DeviceBoxes {
  const float* means2d;      // [count, 2]
  const int32_t* radii;      // [count, 2]
  const float* depths;       // [count]
  const float* conics;       // [count, 3], or null: every tile of the box is touched
  const float* opacities;    // [count], null with conics
  const int32_t* image_ids;  // [count], or null: splat i is of image i / per_image
  int64_t count, per_image;
  int32_t images, tile_size, tile_width, tile_height;
};

// Splats in the order in which their tiles are written, and where each one's tiles start.
struct TileOrder {
  const uint32_t* splats;  // [count], by depth, those without tiles last; null: by index
  int64_t* starts;         // [count + 1]; the last is the number of instances
};

// Fills tile_counts [count] and puts the splats in order.
TileOrder order_splats(const DeviceBoxes& in, bool by_depth, int32_t* tile_counts, CudaScratch& scratch, cudaStream_t stream);

// The instances, as two pairs of buffers to sort between; `current` says which of a pair holds the result. Where `count` is a
// capacity, entries that nothing is written to have the key 0 and the splat -1, and every tile's key is one more: the sort puts
// what is unused in front of the first tile. Splats that do not fit in whole, the last ones in the order, are left out.
struct TileInstances {
  uint32_t* tiles[2];  // image * tiles + tile, and 1 where `count` is a capacity
  int32_t* splats[2];
  int64_t count;
  bool capacity;
  int current;
};
void emit_instances(const DeviceBoxes& in, const TileOrder& order, TileInstances& instances, cudaStream_t stream);
void sort_by_tile(const DeviceBoxes& in, TileInstances& instances, CudaScratch& scratch, cudaStream_t stream);

// offsets[t] = how many of the sorted instances are of tiles in front of t.
void encode_offsets(const TileInstances& instances, int64_t tiles, int32_t* offsets, cudaStream_t stream);
// The same for gsplat's 64-bit ids (image | tile | depth).
void encode_offsets(const int64_t* ids, int64_t count, int64_t images, int64_t tiles_per_image, int32_t* offsets,
                    cudaStream_t stream);
void make_ids(const DeviceBoxes& in, const TileInstances& instances, int64_t* ids, cudaStream_t stream);
