// Interface that each device implements for the ops of this folder: tile lists of checked splats (tiles_cpu_host.cpp,
// tiles_cuda_host.cpp).
#pragma once

#include "host_call.h"
#include "tiles.h"

namespace gsplat::tiles {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// Checked splats. The tensors own the memory that `boxes` points to.
struct Splats {
  Tensor means2d, radii, depths;
  OptionalTensor conics, opacities, image_ids;
  SplatBoxes boxes;
  int64_t tiles;  // of all images
};

struct ListOptions {
  bool sort, ids, offsets;          // sort by depth; return gsplat's 64-bit ids; return the start of each tile
  std::optional<int64_t> capacity;  // fixed length of the list; without it, the exact length
};

struct TileLists {
  Tensor tile_counts, flatten_ids;
  Tensor ids, offsets, needed;  // empty unless requested; `needed` only with a capacity
};

TileLists make_lists(Call& call, const Splats& splats, const ListOptions& options);

// Compute the tiles' starts `offsets` [images, tiles_per_image] from sorted ids.
void offsets_of_ids(const Call& call, const Tensor& ids, int64_t images, int64_t tiles_per_image, int32_t* offsets);

}  // namespace gsplat::tiles
