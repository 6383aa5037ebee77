#include <optional>
#include <tuple>

#include "counting_sort.h"
#include "cpu_call.h"
#include "tiles.h"

namespace {

// Items worth a thread: a splat takes about 2 ns in a pass of the depth sort, 10 ns in one over its tiles.
constexpr int64_t kRadixChunk = 1 << 16, kTilesChunk = 1 << 13;
constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

Tensor empty_longs(int64_t count) {
  return torch::stable::empty(torch::headeronly::IntHeaderOnlyArrayRef(&count, 1), ScalarType::Long);
}

// The inputs of one call, and what the first pass makes of them.
struct Binning {
  Tensor means2d, radii, depths;
  std::optional<Tensor> conics, opacities, image_ids;
  SplatBoxes boxes;
  int64_t count, images, tiles;
  Tensor tile_counts;
  std::unique_ptr<TileSpan[]> spans;
  int64_t total = 0;

  Binning(const Tensor& means2d_, const Tensor& radii_, const Tensor& depths_, const std::optional<Tensor>& conics_,
          const std::optional<Tensor>& opacities_, const std::optional<Tensor>& image_ids_, int64_t images_, int64_t tile_size,
          int64_t tile_width, int64_t tile_height)
      : means2d(floats(means2d_, "means2d")), radii(ints(radii_, "radii")), depths(floats(depths_, "depths")), images(images_) {
    count = depths.numel();
    tiles = images * tile_width * tile_height;
    check(count <= kMostInts, "isect_tiles takes at most 2^31 - 1 splats over all images, got ", count);
    check(tile_size > 0 && tile_width >= 0 && tile_width < 65536 && tile_height >= 0 && tile_height < 65536,
          "isect_tiles: tile_size must be positive and the tile grid below 65536 x 65536");
    check(tiles <= kMostInts, "isect_tiles takes at most 2^31 - 1 tiles over all images, got ", tiles);
    if (conics_) conics = floats(*conics_, "conics"), opacities = floats(opacities_.value(), "opacities");
    if (image_ids_) image_ids = ints(*image_ids_, "image_ids");
    boxes = {data(means2d),
             radii.const_data_ptr<int32_t>(),
             data(depths),
             conics ? data(*conics) : nullptr,
             conics ? data(*opacities) : nullptr,
             image_ids ? image_ids->const_data_ptr<int32_t>() : nullptr,
             images > 0 ? count / images : 0,
             int32_t(tile_size),
             int32_t(tile_width),
             int32_t(tile_height)};
    for (int64_t i = 0; image_ids && i < count; ++i)
      check(boxes.image_ids[i] >= 0 && boxes.image_ids[i] < images, "isect_tiles: image_ids[", i, "] is ", boxes.image_ids[i],
            " but there are ", images, " images");
    tile_counts = empty_ints({count});
    spans = uninitialised<TileSpan>(count);
    int32_t* const counts = tile_counts.mutable_data_ptr<int32_t>();
    torch::stable::parallel_for(
        0, count, 2048, [&](int64_t begin, int64_t end) { tiles_kernels().spans(boxes, begin, end, spans.get(), counts); });
    for (int64_t i = 0; i < count; ++i) total += counts[i];
    check(total <= kMostInts, "the splats touch ", total,
          " tiles in all, more than 2^31 - 1; render fewer images at a time or with a larger tile_size");
  }

  // Visible splats by depth (as bits, so positive depths in front of negative ones, as gsplat sorts), ties by index.
  std::unique_ptr<uint32_t[]> depth_order(int64_t& visible) const {
    struct Item {
      uint32_t key, splat;
    };
    const int32_t* const counts = tile_counts.const_data_ptr<int32_t>();
    const auto* const bits = reinterpret_cast<const uint32_t*>(boxes.depths);
    uint32_t low = ~0u, high = 0;
    visible = 0;
    for (int64_t i = 0; i < count; ++i) {
      if (counts[i] == 0) continue;
      ++visible;
      low = std::min(low, bits[i]);
      high = std::max(high, bits[i]);
    }
    auto order = uninitialised<uint32_t>(visible);
    if (visible == 0) return order;
    // The nearer the depths lie together, the fewer digits they differ in.
    const int width = high == low ? 1 : 32 - __builtin_clz(high - low);
    const int passes = (width + 11) / 12, digit = (width + passes - 1) / passes;
    const uint32_t mask = (1u << digit) - 1;
    auto from = uninitialised<Item>(visible), to = uninitialised<Item>(visible);
    for (int pass = 0; pass < passes; ++pass) {
      const int shift = pass * digit;
      const bool last = pass + 1 == passes;
      const auto put = [&](uint32_t key, uint32_t splat, int32_t* cursor) {
        const int32_t at = cursor[(key >> shift) & mask]++;
        if (last) {
          order[at] = splat;
        } else {
          to[at] = {key, splat};
        }
      };
      if (pass == 0) {
        const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
          for (int64_t i = begin; i < end; ++i)
            if (counts[i] != 0) ++counters[(bits[i] - low) & mask];
        };
        counting_sort(count, kRadixChunk, mask + 1, nullptr, add, [&](int64_t begin, int64_t end, int32_t* cursor) {
          for (int64_t i = begin; i < end; ++i)
            if (counts[i] != 0) put(bits[i] - low, uint32_t(i), cursor);
        });
      } else {
        const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
          for (int64_t i = begin; i < end; ++i) ++counters[(from[i].key >> shift) & mask];
        };
        counting_sort(visible, kRadixChunk, mask + 1, nullptr, add, [&](int64_t begin, int64_t end, int32_t* cursor) {
          for (int64_t i = begin; i < end; ++i) put(from[i].key, from[i].splat, cursor);
        });
      }
      std::swap(from, to);
    }
    return order;
  }

  // Every tile's splats in depth order; `offsets` receives where each tile starts. With a capacity the list is of this length:
  // the nearest splats whose tiles fit in whole, behind entries of -1 that are in no tile.
  Tensor sorted(int32_t* offsets, int64_t* keys, std::optional<int64_t> capacity = std::nullopt) const {
    int64_t visible, listed = total;
    const auto order = depth_order(visible);
    if (capacity && total > *capacity) {
      const int32_t* const counts = tile_counts.const_data_ptr<int32_t>();
      int64_t fitting = 0;
      for (listed = 0; listed + counts[order[fitting]] <= *capacity; ++fitting) listed += counts[order[fitting]];
      visible = fitting;
    }
    const int64_t unused = capacity ? *capacity - listed : 0;
    Tensor flatten_ids = empty_ints({unused + listed});
    int32_t* const ids = flatten_ids.mutable_data_ptr<int32_t>() + unused;
    std::fill(ids - unused, ids, -1);
    const TilesKernels& kernels = tiles_kernels();
    const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
      kernels.count(boxes, spans.get(), order.get(), begin, end, counters);
    };
    counting_sort(visible, kTilesChunk, tiles, offsets, add, [&](int64_t begin, int64_t end, int32_t* cursors) {
      kernels.emit(boxes, spans.get(), order.get(), begin, end, cursors, ids, keys);
    });
    for (int64_t i = 0; unused > 0 && i < tiles; ++i) offsets[i] += int32_t(unused);
    return flatten_ids;
  }
};

std::tuple<Tensor, Tensor, Tensor> isect_tiles(Tensor means2d, Tensor radii, Tensor depths, std::optional<Tensor> conics,
                                               std::optional<Tensor> opacities, std::optional<Tensor> image_ids, int64_t images,
                                               int64_t tile_size, int64_t tile_width, int64_t tile_height, bool sort) {
  const Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  Tensor isect_ids = empty_longs(binning.total);
  int64_t* const keys = isect_ids.mutable_data_ptr<int64_t>();
  if (sort) return {binning.tile_counts, isect_ids, binning.sorted(nullptr, keys)};
  Tensor flatten_ids = empty_ints({binning.total});
  const int32_t* const counts = binning.tile_counts.const_data_ptr<int32_t>();
  int64_t at = 0;
  for (int64_t i = 0; i < binning.count; at += counts[i++])
    if (counts[i] != 0)
      tiles_kernels().emit_one(binning.boxes, binning.spans[i], i, at, flatten_ids.mutable_data_ptr<int32_t>(), keys);
  return {binning.tile_counts, isect_ids, flatten_ids};
}

std::tuple<Tensor, Tensor, Tensor> bin_splats(Tensor means2d, Tensor radii, Tensor depths, std::optional<Tensor> conics,
                                              std::optional<Tensor> opacities, std::optional<Tensor> image_ids, int64_t images,
                                              int64_t tile_size, int64_t tile_width, int64_t tile_height) {
  const Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  Tensor offsets = empty_ints({images, tile_height, tile_width});
  Tensor flatten_ids = binning.sorted(offsets.mutable_data_ptr<int32_t>(), nullptr);
  return {binning.tile_counts, flatten_ids, offsets};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> bin_splats_within(Tensor means2d, Tensor radii, Tensor depths,
                                                             std::optional<Tensor> conics, std::optional<Tensor> opacities,
                                                             std::optional<Tensor> image_ids, int64_t images, int64_t tile_size,
                                                             int64_t tile_width, int64_t tile_height, int64_t capacity) {
  check(capacity >= 0 && capacity <= kMostInts, "bin_splats: capacity must be 0 to 2^31 - 1, got ", capacity);
  const Binning binning(means2d, radii, depths, conics, opacities, image_ids, images, tile_size, tile_width, tile_height);
  Tensor offsets = empty_ints({images, tile_height, tile_width}), needed = empty_longs(1);
  *needed.mutable_data_ptr<int64_t>() = binning.total;
  Tensor flatten_ids = binning.sorted(offsets.mutable_data_ptr<int32_t>(), nullptr, capacity);
  return {binning.tile_counts, flatten_ids, offsets, needed};
}

Tensor isect_offset_encode(Tensor isect_ids, int64_t images, int64_t tile_width, int64_t tile_height) {
  check(isect_ids.is_cpu() && isect_ids.scalar_type() == ScalarType::Long, "isect_ids must be int64 on the CPU");
  const Tensor sorted = isect_ids.is_contiguous() ? isect_ids : torch::stable::contiguous(isect_ids);
  const int64_t* const ids = sorted.const_data_ptr<int64_t>();
  const int64_t count = sorted.numel(), tiles = tile_width * tile_height;
  check(count <= kMostInts && images * tiles <= kMostInts, "isect_offset_encode: more than 2^31 - 1 entries");
  Tensor offsets = empty_ints({images, tile_height, tile_width});
  int32_t* const out = offsets.mutable_data_ptr<int32_t>();
  const int tile_bits = tiles > 0 ? 64 - __builtin_clzll(uint64_t(tiles)) : 1;
  int64_t next = 0;  // first tile without an offset
  for (int64_t i = 0; i < count; ++i) {
    const int64_t key = ids[i] >> 32, image = key >> tile_bits, tile = key & ((int64_t(1) << tile_bits) - 1);
    check(image >= 0 && image < images && tile < tiles, "isect_offset_encode: isect_ids[", i, "] is for image ", image, ", tile ",
          tile, " but there are ", images, " images of ", tiles, " tiles");
    for (const int64_t here = image * tiles + tile; next <= here; ++next) out[next] = int32_t(i);
  }
  for (; next < images * tiles; ++next) out[next] = int32_t(count);
  return offsets;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("isect_tiles", GSPLAT_BOX(&isect_tiles));
  m.impl("bin_splats", GSPLAT_BOX(&bin_splats));
  m.impl("bin_splats_within", GSPLAT_BOX(&bin_splats_within));
  m.impl("isect_offset_encode", GSPLAT_BOX(&isect_offset_encode));
}
