#include <atomic>
#include <new>
#include <optional>
#include <tuple>

#include "compositing.h"
#include "counting_sort.h"
#include "cpu_call.h"

namespace {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

struct alignas(64) Line {
  float floats[16];
};

// The inputs of either pass, checked, and the record of every splat.
struct Call {
  Tensor means2d, conics, colors, opacities, offsets, flatten_ids;
  std::optional<Tensor> backgrounds, masks;
  std::unique_ptr<SplatRecord[]> records;
  Compositing in;
  int64_t count, tiles;

  Call(const Tensor& means2d_, const Tensor& conics_, const Tensor& colors_, const Tensor& opacities_, const Tensor& offsets_,
       const Tensor& flatten_ids_, const std::optional<Tensor>& backgrounds_, const std::optional<Tensor>& masks_, int64_t width,
       int64_t height, int64_t tile_size)
      : means2d(floats(means2d_, "means2d")),
        conics(floats(conics_, "conics")),
        colors(floats(colors_, "colors")),
        opacities(floats(opacities_, "opacities")),
        offsets(ints(offsets_, "isect_offsets")),
        flatten_ids(ints(flatten_ids_, "flatten_ids")) {
    const int64_t channels = colors.size(-1), images = offsets.size(0);
    const int64_t tile_height = offsets.size(1), tile_width = offsets.size(2);
    count = opacities.numel();
    tiles = offsets.numel();
    check(means2d.numel() == 2 * count && conics.numel() == 3 * count && colors.numel() == channels * count,
          "composite: means2d, conics, colors and opacities must be of the same splats");
    check(tile_size > 0 && width >= 0 && height >= 0 && width < kMostInts && height < kMostInts && tile_size < kMostInts &&
              tile_width * tile_size >= width && tile_height * tile_size >= height,
          "composite: the tiles of isect_offsets do not cover the image");
    if (backgrounds_) backgrounds = floats(*backgrounds_, "backgrounds");
    if (masks_) {
      check(masks_->is_cpu() && masks_->scalar_type() == ScalarType::Bool && masks_->numel() == tiles,
            "composite: masks must have one bool per tile");
      masks = masks_->is_contiguous() ? *masks_ : torch::stable::contiguous(*masks_);
    }
    check_lists();
    records = uninitialised<SplatRecord>(count);
    in = {records.get(),
          data(colors),
          data(means2d),
          data(conics),
          data(opacities),
          int32_t(channels),
          offsets.const_data_ptr<int32_t>(),
          flatten_ids.const_data_ptr<int32_t>(),
          flatten_ids.numel(),
          int32_t(images),
          int32_t(width),
          int32_t(height),
          int32_t(tile_size),
          int32_t(tile_width),
          int32_t(tile_height),
          backgrounds ? data(*backgrounds) : nullptr,
          masks ? masks->const_data_ptr<bool>() : nullptr};
    torch::stable::parallel_for(
        0, count, 2048, [&](int64_t begin, int64_t end) { compositing_kernels().records(in, begin, end, records.get()); });
  }

  // What lies in front of the first tile's list is unused: lists of a fixed capacity fill up from the end.
  int64_t first_listed() const { return tiles > 0 ? offsets.const_data_ptr<int32_t>()[0] : flatten_ids.numel(); }

  // The lists come from the caller, and a wrong index would read foreign memory.
  void check_lists() const {
    const int32_t *starts = offsets.const_data_ptr<int32_t>(), *ids = flatten_ids.const_data_ptr<int32_t>();
    const int64_t instances = flatten_ids.numel();
    int32_t before = 0;
    bool ordered = true;
    for (int64_t i = 0; i < tiles; ++i) ordered &= starts[i] >= before, before = starts[i];
    check(ordered && before <= instances, "isect_offsets must rise from 0 to at most the length of flatten_ids");
    uint32_t most = 0;
    for (int64_t i = first_listed(); i < instances; ++i) most = std::max(most, uint32_t(ids[i]));
    check(first_listed() == instances || most < count, "flatten_ids must be in [0, ", count, "), found ", int32_t(most));
  }

  // run(tile, scratch) for all tiles: threads take the next free one, and no result depends on which takes which.
  template <class Run>
  void for_tiles(const Run& run) const {
    constexpr int64_t kRun = 4;
    std::atomic<int64_t> next{0};
    const int64_t workers = std::max<int64_t>(1, std::min<int64_t>(torch::stable::get_num_threads(), tiles));
    const int64_t scratch = compositing_kernels().scratch_floats(in.channels);
    torch::stable::parallel_for(0, workers, 1, [&](int64_t, int64_t) {
      const auto lines = uninitialised<Line>(scratch / 16 + 1);
      // A few neighbours at a time: they share splats, and the next one's are being fetched.
      for (int64_t first; (first = next.fetch_add(kRun, std::memory_order_relaxed)) < tiles;)
        for (int64_t tile = first; tile < std::min(first + kRun, tiles); ++tile) run(tile, lines[0].floats);
    });
  }
};

std::tuple<Tensor, Tensor, Tensor> composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets,
                                             Tensor flatten_ids, std::optional<Tensor> backgrounds, std::optional<Tensor> masks,
                                             std::optional<Tensor> absgrad_probe, int64_t width, int64_t height,
                                             int64_t tile_size) {
  const Call call(means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height, tile_size);
  const int64_t images = call.in.images;
  Tensor out_colors = empty_floats({images, height, width, call.in.channels});
  Tensor out_alphas = empty_floats({images, height, width, 1});
  Tensor out_last = empty_ints({images, height, width});
  const CompositedPixels out = {mutable_data(out_colors), mutable_data(out_alphas), out_last.mutable_data_ptr<int32_t>()};
  call.for_tiles([&](int64_t tile, float* scratch) { compositing_kernels().tile(call.in, tile, out, scratch); });
  return {out_colors, out_alphas, out_last};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> composite_backward(
    Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets, Tensor flatten_ids,
    std::optional<Tensor> backgrounds, std::optional<Tensor> masks, int64_t width, int64_t height, int64_t tile_size,
    Tensor alphas, Tensor last, Tensor v_colors, Tensor v_alphas, bool absgrad) {
  const Call call(means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height, tile_size);
  const int64_t count = call.count, instances = call.in.instances, channels = call.in.channels, images = call.in.images;
  const int64_t pixels = images * height * width;
  const Tensor alphas_ = floats(alphas, "alphas"), last_ = ints(last, "last");
  const Tensor v_colors_ = floats(v_colors, "v_colors"), v_alphas_ = floats(v_alphas, "v_alphas");
  check(alphas_.numel() == pixels && last_.numel() == pixels && v_alphas_.numel() == pixels &&
            v_colors_.numel() == pixels * channels,
        "composite_backward: alphas, last, v_colors and v_alphas must be of the image's size");

  // A row for every instance, those of one splat next to each other in the order of the lists.
  auto first = uninitialised<int32_t>(count + 1), slots = uninitialised<int32_t>(instances);
  const int64_t unused = call.first_listed(), listed = instances - unused;
  const int32_t* const ids = call.in.flatten_ids + unused;
  const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
    for (int64_t i = begin; i < end; ++i) ++counters[ids[i]];
  };
  counting_sort(listed, 1 << 15, count, first.get(), add, [&](int64_t begin, int64_t end, int32_t* cursors) {
    for (int64_t i = begin; i < end; ++i) slots[unused + i] = cursors[ids[i]]++;
  });
  first[count] = int32_t(listed);

  const int64_t lines_per_row = (kMoments + channels + (absgrad ? 2 : 0) + 15) / 16;
  const auto rows = uninitialised<Line>(listed * lines_per_row);
  std::vector<float> background_parts(backgrounds ? size_t(call.tiles * channels) : 0, 0.0f);
  const CompositingGradients gradients = {data(alphas_),
                                          last_.const_data_ptr<int32_t>(),
                                          data(v_colors_),
                                          data(v_alphas_),
                                          absgrad,
                                          slots.get(),
                                          rows[0].floats,
                                          lines_per_row * 16,
                                          backgrounds ? background_parts.data() : nullptr};
  call.for_tiles([&](int64_t tile, float* scratch) { compositing_kernels().tile_backward(call.in, tile, gradients, scratch); });

  Tensor v_means2d = empty_floats({count, 2}), v_conics = empty_floats({count, 3}),
         v_splat_colors = empty_floats({count, channels});
  Tensor v_opacities = empty_floats({count}), v_absolute = empty_floats({absgrad ? count : 0, 2});
  torch::stable::parallel_for(0, count, 2048, [&](int64_t begin, int64_t end) {
    compositing_kernels().gather(call.in, gradients, first.get(), begin, end, mutable_data(v_means2d), mutable_data(v_conics),
                                 mutable_data(v_splat_colors), mutable_data(v_opacities), mutable_data(v_absolute));
  });

  Tensor v_backgrounds = zero_floats({backgrounds ? images : 0, channels});
  for (int64_t image = 0; backgrounds && image < images; ++image)
    for (int64_t d = 0; d < channels; ++d) {
      double total = 0;
      for (int64_t tile = image * (call.tiles / images); tile < (image + 1) * (call.tiles / images); ++tile)
        total += background_parts[size_t(tile * channels + d)];
      mutable_data(v_backgrounds)[image * channels + d] = float(total);
    }
  return {v_means2d, v_conics, v_splat_colors, v_opacities, v_backgrounds, v_absolute};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("composite", GSPLAT_BOX(&composite));
  m.impl("composite_backward", GSPLAT_BOX(&composite_backward));
}
