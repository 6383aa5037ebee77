// Host code shared by the ops that blend the splats of one image in tiles of 16 pixels: checks of splats and lists.
#pragma once

#include "compositing.h"
#include "host_call.h"

namespace gsplat::compositing {
namespace {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// Checked splats of an op named `op`. The tensors own the memory that `in` points to. Values of the lists are checked by
// the CPU's passes only (`check_lists`), because the host would have to wait for a GPU.
struct TiledSplats {
  Tensor means2d, conics, opacities, offsets, flatten_ids;
  Inputs in;  // of one image, without colours

  TiledSplats(const Call& call, const char* op, const Tensor& means2d_, const Tensor& conics_, const Tensor& opacities_,
              const Tensor& offsets_, const Tensor& flatten_ids_, int64_t width, int64_t height, AlphaLimit alpha = {})
      : means2d(call.floats(means2d_, "means2d")),
        conics(call.floats(conics_, "conics")),
        opacities(call.floats(opacities_, "opacities")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")) {
    check(offsets.dim() == 2, op, ": isect_offsets must be [tile_height, tile_width]");
    const int64_t count = opacities.numel(), tile_height = offsets.size(0), tile_width = offsets.size(1);
    check(means2d.numel() == 2 * count && conics.numel() == 3 * count, op,
          ": means2d, conics and opacities must be of the same splats");
    check(width >= 0 && height >= 0 && width < kMostInts && height < kMostInts && tile_width * kTileSize >= width &&
              tile_height * kTileSize >= height && tile_width * tile_height < kMostInts,
          op, ": the tiles of isect_offsets, of ", kTileSize, " pixels, do not cover the image");
    check(count < kMostInts && flatten_ids.numel() <= kMostInts, op, ": more than 2^31 - 1 splats or instances");
    in = {.means2d = data(means2d),
          .conics = data(conics),
          .colors = nullptr,
          .opacities = data(opacities),
          .offsets = offsets.const_data_ptr<int32_t>(),
          .flatten_ids = flatten_ids.const_data_ptr<int32_t>(),
          .backgrounds = nullptr,
          .masks = nullptr,
          .count = count,
          .instances = flatten_ids.numel(),
          .images = 1,
          .channels = 0,
          .width = int32_t(width),
          .height = int32_t(height),
          .tile_size = kTileSize,
          .tile_width = int32_t(tile_width),
          .tile_height = int32_t(tile_height),
          .alpha = alpha};
  }

  // Checks that a tensor has `width` numbers for each splat.
  void check_rows(const char* op, const char* name, const Tensor& rows, int64_t width) const {
    check(rows.numel() == width * in.count, op, ": ", name, " must have ", width, " numbers for each of ", in.count, " splats");
  }
};

}  // namespace
}  // namespace gsplat::compositing
