#include "counting_sort.h"
#include "tile_lists.h"

namespace gsplat::tiles {
namespace {

// Minimum items per task: a splat takes about 2 ns in a pass of the depth sort, and 10 ns in a pass over its tiles.
constexpr int64_t kRadixChunk = 1 << 16, kTilesChunk = 1 << 13;

// The first pass over the splats, and the subsequent sorts.
struct Binning {
  const SplatBoxes& boxes;
  int64_t count, tiles;
  Tensor tile_counts;
  std::unique_ptr<TileSpan[]> spans;
  int64_t total = 0;

  Binning(const Call& call, const Splats& splats)
      : boxes(splats.boxes),
        count(boxes.count),
        tiles(splats.tiles),
        tile_counts(call.empty({count}, ScalarType::Int)),
        spans(uninitialised<TileSpan>(count)) {
    for (int64_t i = 0; boxes.image_ids != nullptr && i < count; ++i)
      check(boxes.image_ids[i] >= 0 && boxes.image_ids[i] < boxes.images, "isect_tiles: image_ids[", i, "] is ",
            boxes.image_ids[i], " but there are ", boxes.images, " images");
    int32_t* const counts = tile_counts.mutable_data_ptr<int32_t>();
    torch::stable::parallel_for(0, count, 2048,
                                [&](int64_t begin, int64_t end) { kernels().spans(boxes, begin, end, spans.get(), counts); });
    for (int64_t i = 0; i < count; ++i) total += counts[i];
    check(total <= kMostInts, "the splats touch ", total,
          " tiles in all, more than 2^31 - 1; render fewer images at a time or with a larger tile_size");
  }

  // Return the visible splats by depth, ties by index. Depths are sorted by their bits, so positive depths precede
  // negative ones, as in gsplat.
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
    // The narrower the range of depths, the fewer digits have to be sorted.
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

  // Return every tile's splats in depth order; `offsets` receives the start of each tile. With a capacity the list has
  // that length: leading entries of -1, which belong to no tile, then the nearest splats that fit completely.
  Tensor sorted(const Call& call, int32_t* offsets, int64_t* keys, std::optional<int64_t> capacity) const {
    int64_t visible, listed = total;
    const auto order = depth_order(visible);
    if (capacity && total > *capacity) {
      const int32_t* const counts = tile_counts.const_data_ptr<int32_t>();
      int64_t fitting = 0;
      for (listed = 0; listed + counts[order[fitting]] <= *capacity; ++fitting) listed += counts[order[fitting]];
      visible = fitting;
    }
    const int64_t unused = capacity ? *capacity - listed : 0;
    Tensor flatten_ids = call.empty({unused + listed}, ScalarType::Int);
    int32_t* const ids = flatten_ids.mutable_data_ptr<int32_t>() + unused;
    std::fill(ids - unused, ids, -1);
    const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
      kernels().count(boxes, spans.get(), order.get(), begin, end, counters);
    };
    counting_sort(visible, kTilesChunk, tiles, offsets, add, [&](int64_t begin, int64_t end, int32_t* cursors) {
      kernels().emit(boxes, spans.get(), order.get(), begin, end, cursors, ids, keys);
    });
    for (int64_t i = 0; unused > 0 && i < tiles; ++i) offsets[i] += int32_t(unused);
    return flatten_ids;
  }

  // Return the tiles in splat order, without sorting.
  Tensor by_splat(const Call& call, int64_t* keys) const {
    Tensor flatten_ids = call.empty({total}, ScalarType::Int);
    const int32_t* const counts = tile_counts.const_data_ptr<int32_t>();
    int64_t at = 0;
    for (int64_t i = 0; i < count; at += counts[i++])
      if (counts[i] != 0) kernels().emit_one(boxes, spans[i], i, at, flatten_ids.mutable_data_ptr<int32_t>(), keys);
    return flatten_ids;
  }
};

}  // namespace

TileLists make_lists(Call& call, const Splats& splats, const ListOptions& options) {
  const Binning binning(call, splats);
  TileLists lists = {binning.tile_counts, {}, {}, {}, {}};
  if (options.ids) lists.ids = call.empty({binning.total}, ScalarType::Long);
  int64_t* const keys = options.ids ? lists.ids.mutable_data_ptr<int64_t>() : nullptr;
  if (options.offsets)
    lists.offsets = call.empty({splats.boxes.images, splats.boxes.tile_height, splats.boxes.tile_width}, ScalarType::Int);
  int32_t* const offsets = options.offsets ? lists.offsets.mutable_data_ptr<int32_t>() : nullptr;
  if (options.capacity) {
    lists.needed = call.empty({1}, ScalarType::Long);
    *lists.needed.mutable_data_ptr<int64_t>() = binning.total;
  }
  lists.flatten_ids = options.sort ? binning.sorted(call, offsets, keys, options.capacity) : binning.by_splat(call, keys);
  return lists;
}

void offsets_of_ids(const Call&, const Tensor& sorted, int64_t images, int64_t tiles, int32_t* offsets) {
  const int64_t* const ids = sorted.const_data_ptr<int64_t>();
  const int64_t count = sorted.numel();
  const int tile_bits = tiles > 0 ? 64 - __builtin_clzll(uint64_t(tiles)) : 1;
  int64_t next = 0;  // first tile whose offset is not yet written
  for (int64_t i = 0; i < count; ++i) {
    const int64_t key = ids[i] >> 32, image = key >> tile_bits, tile = key & ((int64_t(1) << tile_bits) - 1);
    check(image >= 0 && image < images && tile < tiles, "isect_offset_encode: isect_ids[", i, "] is for image ", image, ", tile ",
          tile, " but there are ", images, " images of ", tiles, " tiles");
    for (const int64_t here = image * tiles + tile; next <= here; ++next) offsets[next] = int32_t(i);
  }
  for (; next < images * tiles; ++next) offsets[next] = int32_t(count);
}

}  // namespace gsplat::tiles
