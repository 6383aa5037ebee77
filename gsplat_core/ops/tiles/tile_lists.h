// What the ops of this folder ask of either device: the lists of checked splats (tiles_cpu_host.cpp, tiles_cuda_host.cpp).
#pragma once

#include "host_call.h"
#include "tiles.h"

namespace gsplat::tiles {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// Checked splats; the tensors keep the memory alive that `boxes` points to.
struct Splats {
  Tensor means2d, radii, depths;
  OptionalTensor conics, opacities, image_ids;
  SplatBoxes boxes;
  int64_t tiles;  // of all images
};

struct ListOptions {
  bool sort, ids, offsets;          // in depth order; gsplat's 64-bit ids; where each tile starts
  std::optional<int64_t> capacity;  // the list's length; without it, as long as it must be
};

struct TileLists {
  Tensor tile_counts, flatten_ids;
  Tensor ids, offsets, needed;  // empty unless asked for; `needed` with a capacity
};

TileLists make_lists(Call& call, const Splats& splats, const ListOptions& options);

// Where the tiles of sorted ids start: `offsets` [images, tiles_per_image].
void offsets_of_ids(const Call& call, const Tensor& ids, int64_t images, int64_t tiles_per_image, int32_t* offsets);

}  // namespace gsplat::tiles
