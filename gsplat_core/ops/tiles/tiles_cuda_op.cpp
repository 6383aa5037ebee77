#include <optional>
#include <tuple>

#include "cuda_call.h"
#include "tiles_cuda.h"

namespace {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// One call: its inputs, and the instances in the order of the splats' depth or index. What the CPU refuses after a look at the
// values (an image_id that is no image's) is in no list here: looking would make the host wait.
struct Binning {
  CudaCall call;
  Tensor means2d, radii, depths;
  std::optional<Tensor> conics, opacities, image_ids;
  DeviceBoxes boxes;
  int64_t tiles;
  Tensor tile_counts, splats[2], needed;
  TileInstances instances = {};

  Binning(const Tensor& means2d_, const Tensor& radii_, const Tensor& depths_, const std::optional<Tensor>& conics_,
          const std::optional<Tensor>& opacities_, const std::optional<Tensor>& image_ids_, int64_t images, int64_t tile_size,
          int64_t tile_width, int64_t tile_height, bool sort, std::optional<int64_t> capacity = std::nullopt)
      : call(depths_),
        means2d(call.floats(means2d_, "means2d")),
        radii(call.ints(radii_, "radii")),
        depths(call.floats(depths_, "depths")),
        tiles(images * tile_width * tile_height) {
    const int64_t count = depths.numel();
    check(count <= kMostInts, "isect_tiles takes at most 2^31 - 1 splats over all images, got ", count);
    check(tile_size > 0 && tile_width >= 0 && tile_width < 65536 && tile_height >= 0 && tile_height < 65536,
          "isect_tiles: tile_size must be positive and the tile grid below 65536 x 65536");
    check(tiles <= kMostInts, "isect_tiles takes at most 2^31 - 1 tiles over all images, got ", tiles);
    if (conics_) conics = call.floats(*conics_, "conics"), opacities = call.floats(opacities_.value(), "opacities");
    if (image_ids_) image_ids = call.ints(*image_ids_, "image_ids");
    boxes = {data(means2d),
             radii.const_data_ptr<int32_t>(),
             data(depths),
             conics ? data(*conics) : nullptr,
             conics ? data(*opacities) : nullptr,
             image_ids ? image_ids->const_data_ptr<int32_t>() : nullptr,
             count,
             images > 0 ? count / images : 0,
             int32_t(images),
             int32_t(tile_size),
             int32_t(tile_width),
             int32_t(tile_height)};
    tile_counts = call.empty({count}, ScalarType::Int);
    TileOrder order = {};
    if (count > 0) order = order_splats(boxes, sort, tile_counts.mutable_data_ptr<int32_t>(), call, call.stream);
    if (capacity) {
      check(*capacity >= 0 && *capacity <= kMostInts, "bin_splats: capacity must be 0 to 2^31 - 1, got ", *capacity);
      instances.capacity = true;
      instances.count = *capacity;
      needed = call.empty({1}, ScalarType::Long);
      int64_t* const out = needed.mutable_data_ptr<int64_t>();
      check_cuda(count > 0 ? cudaMemcpyAsync(out, order.starts + count, sizeof(int64_t), cudaMemcpyDeviceToDevice, call.stream)
                           : cudaMemsetAsync(out, 0, sizeof(int64_t), call.stream),
                 "keeping the number of instances");
    } else if (count > 0) {
      // The host waits here, once, for the number of instances: the lists that are returned are exactly as long.
      check_cuda(cudaMemcpyAsync(&instances.count, order.starts + count, sizeof(int64_t), cudaMemcpyDeviceToHost, call.stream),
                 "reading the number of instances");
      check_cuda(cudaStreamSynchronize(call.stream), "sorting the splats by depth");
    }
    check(instances.count <= kMostInts, "the splats touch ", instances.count,
          " tiles in all, more than 2^31 - 1; render fewer images at a time or with a larger tile_size");
    for (int i = 0; i < (sort ? 2 : 1); ++i) {
      splats[i] = call.empty({instances.count}, ScalarType::Int);
      instances.splats[i] = splats[i].mutable_data_ptr<int32_t>();
      instances.tiles[i] = call.array<uint32_t>(instances.count);
    }
    emit_instances(boxes, order, instances, call.stream);
    if (sort) sort_by_tile(boxes, instances, call, call.stream);
  }

  Tensor flatten_ids() const { return splats[instances.current]; }
};

std::tuple<Tensor, Tensor, Tensor> isect_tiles(Tensor means2d, Tensor radii, Tensor depths, std::optional<Tensor> conics,
                                               std::optional<Tensor> opacities, std::optional<Tensor> image_ids, int64_t images,
                                               int64_t tile_size, int64_t tile_width, int64_t tile_height, bool sort) {
  Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height, sort);
  Tensor ids = binning.call.empty({binning.instances.count}, ScalarType::Long);
  make_ids(binning.boxes, binning.instances, ids.mutable_data_ptr<int64_t>(), binning.call.stream);
  check_cuda(cudaGetLastError(), "isect_tiles");
  return {binning.tile_counts, ids, binning.flatten_ids()};
}

Tensor offsets_of(const Binning& binning, int64_t images, int64_t tile_height, int64_t tile_width) {
  Tensor offsets = binning.call.empty({images, tile_height, tile_width}, ScalarType::Int);
  encode_offsets(binning.instances, binning.tiles, offsets.mutable_data_ptr<int32_t>(), binning.call.stream);
  return offsets;
}

std::tuple<Tensor, Tensor, Tensor> bin_splats(Tensor means2d, Tensor radii, Tensor depths, std::optional<Tensor> conics,
                                              std::optional<Tensor> opacities, std::optional<Tensor> image_ids, int64_t images,
                                              int64_t tile_size, int64_t tile_width, int64_t tile_height) {
  Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height, true);
  Tensor offsets = offsets_of(binning, images, tile_height, tile_width);
  check_cuda(cudaGetLastError(), "bin_splats");
  return {binning.tile_counts, binning.flatten_ids(), offsets};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> bin_splats_within(Tensor means2d, Tensor radii, Tensor depths,
                                                             std::optional<Tensor> conics, std::optional<Tensor> opacities,
                                                             std::optional<Tensor> image_ids, int64_t images, int64_t tile_size,
                                                             int64_t tile_width, int64_t tile_height, int64_t capacity) {
  Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height, true,
                  capacity);
  Tensor offsets = offsets_of(binning, images, tile_height, tile_width);
  check_cuda(cudaGetLastError(), "bin_splats");
  return {binning.tile_counts, binning.flatten_ids(), offsets, binning.needed};
}

Tensor isect_offset_encode(Tensor isect_ids, int64_t images, int64_t tile_width, int64_t tile_height) {
  CudaCall call(isect_ids);
  const Tensor sorted = call.take(isect_ids, ScalarType::Long, "isect_ids");
  const int64_t tiles = tile_width * tile_height;
  check(sorted.numel() <= kMostInts && images * tiles <= kMostInts, "isect_offset_encode: more than 2^31 - 1 entries");
  Tensor offsets = call.empty({images, tile_height, tile_width}, ScalarType::Int);
  encode_offsets(sorted.const_data_ptr<int64_t>(), sorted.numel(), images, tiles, offsets.mutable_data_ptr<int32_t>(),
                 call.stream);
  check_cuda(cudaGetLastError(), "isect_offset_encode");
  return offsets;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("isect_tiles", GSPLAT_BOX(&isect_tiles));
  m.impl("bin_splats", GSPLAT_BOX(&bin_splats));
  m.impl("bin_splats_within", GSPLAT_BOX(&bin_splats_within));
  m.impl("isect_offset_encode", GSPLAT_BOX(&isect_offset_encode));
}
