#include <tuple>

#include "tile_lists.h"

namespace gsplat::tiles {
namespace {

Splats splats_of(const Call& call, const Tensor& means2d, const Tensor& radii, const Tensor& depths, const OptionalTensor& conics,
                 const OptionalTensor& opacities, const OptionalTensor& image_ids, int64_t images, int64_t tile_size,
                 int64_t tile_width, int64_t tile_height) {
  Splats s = {call.floats(means2d, "means2d"),
              call.ints(radii, "radii"),
              call.floats(depths, "depths"),
              call.floats(conics, "conics"),
              call.floats(opacities, "opacities"),
              call.ints(image_ids, "image_ids"),
              {},
              images * tile_width * tile_height};
  const int64_t count = s.depths.numel();
  check(count <= kMostInts, "isect_tiles takes at most 2^31 - 1 splats over all images, got ", count);
  check(tile_size > 0 && tile_width >= 0 && tile_width < 65536 && tile_height >= 0 && tile_height < 65536,
        "isect_tiles: tile_size must be positive and the tile grid below 65536 x 65536, got tiles of ", tile_size, " px and ",
        tile_width, " x ", tile_height);
  check(images >= 0 && s.tiles <= kMostInts, "isect_tiles takes at most 2^31 - 1 tiles over all images, got ", s.tiles);
  check(s.conics.has_value() == s.opacities.has_value(), "isect_tiles takes conics and opacities together, or neither");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == columns * count; };
  check(s.means2d.numel() == 2 * count && s.radii.numel() == 2 * count && fits(s.conics, 3) && fits(s.opacities, 1) &&
            fits(s.image_ids, 1),
        "isect_tiles: the sizes of the inputs do not fit ", count, " depths");
  s.boxes = {data(s.means2d),
             s.radii.const_data_ptr<int32_t>(),
             data(s.depths),
             data(s.conics),
             data(s.opacities),
             s.image_ids ? s.image_ids->const_data_ptr<int32_t>() : nullptr,
             count,
             images > 0 ? count / images : 0,
             int32_t(images),
             int32_t(tile_size),
             int32_t(tile_width),
             int32_t(tile_height)};
  return s;
}

std::tuple<Tensor, Tensor, Tensor> isect_tiles(Tensor means2d, Tensor radii, Tensor depths, OptionalTensor conics,
                                               OptionalTensor opacities, OptionalTensor image_ids, int64_t images,
                                               int64_t tile_size, int64_t tile_width, int64_t tile_height, bool sort) {
  Call call(depths);
  const Splats splats =
      splats_of(call, means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  const TileLists lists = make_lists(call, splats, {sort, true, false, std::nullopt});
  call.finish("isect_tiles");
  return {lists.tile_counts, lists.ids, lists.flatten_ids};
}

std::tuple<Tensor, Tensor, Tensor> bin_splats(Tensor means2d, Tensor radii, Tensor depths, OptionalTensor conics,
                                              OptionalTensor opacities, OptionalTensor image_ids, int64_t images,
                                              int64_t tile_size, int64_t tile_width, int64_t tile_height) {
  Call call(depths);
  const Splats splats =
      splats_of(call, means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  const TileLists lists = make_lists(call, splats, {true, false, true, std::nullopt});
  call.finish("bin_splats");
  return {lists.tile_counts, lists.flatten_ids, lists.offsets};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> bin_splats_within(Tensor means2d, Tensor radii, Tensor depths, OptionalTensor conics,
                                                             OptionalTensor opacities, OptionalTensor image_ids, int64_t images,
                                                             int64_t tile_size, int64_t tile_width, int64_t tile_height,
                                                             int64_t capacity) {
  Call call(depths);
  check(capacity >= 0 && capacity <= kMostInts, "bin_splats: capacity must be 0 to 2^31 - 1, got ", capacity);
  const Splats splats =
      splats_of(call, means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  const TileLists lists = make_lists(call, splats, {true, false, true, capacity});
  call.finish("bin_splats");
  return {lists.tile_counts, lists.flatten_ids, lists.offsets, lists.needed};
}

Tensor isect_offset_encode(Tensor isect_ids, int64_t images, int64_t tile_width, int64_t tile_height) {
  const Call call(isect_ids);
  const Tensor ids = call.take(isect_ids, ScalarType::Long, "isect_ids");
  const int64_t tiles = tile_width * tile_height;
  check(ids.numel() <= kMostInts && images * tiles <= kMostInts, "isect_offset_encode takes at most 2^31 - 1 ids and tiles, got ",
        ids.numel(), " and ", images * tiles);
  Tensor offsets = call.empty({images, tile_height, tile_width}, ScalarType::Int);
  offsets_of_ids(call, ids, images, tiles, offsets.mutable_data_ptr<int32_t>());
  call.finish("isect_offset_encode");
  return offsets;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("isect_tiles", GSPLAT_BOX(&isect_tiles));
  m.impl("bin_splats", GSPLAT_BOX(&bin_splats));
  m.impl("bin_splats_within", GSPLAT_BOX(&bin_splats_within));
  m.impl("isect_offset_encode", GSPLAT_BOX(&isect_offset_encode));
}

}  // namespace gsplat::tiles
