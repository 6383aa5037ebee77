#include <optional>
#include <tuple>

#include "compositing_cuda.h"
#include "cuda_call.h"

namespace {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;

// The inputs of either pass, checked. Unlike on the CPU the lists' values are not looked at, for that would make the host wait:
// a position outside of flatten_ids is cut off and an index that is no splat's is skipped.
struct Compositing {
  CudaCall call;
  Tensor means2d, conics, colors, opacities, offsets, flatten_ids;
  std::optional<Tensor> backgrounds, masks;
  DeviceCompositing in;

  Compositing(const Tensor& means2d_, const Tensor& conics_, const Tensor& colors_, const Tensor& opacities_,
              const Tensor& offsets_, const Tensor& flatten_ids_, const std::optional<Tensor>& backgrounds_,
              const std::optional<Tensor>& masks_, int64_t width, int64_t height, int64_t tile_size)
      : call(means2d_),
        means2d(call.floats(means2d_, "means2d")),
        conics(call.floats(conics_, "conics")),
        colors(call.floats(colors_, "colors")),
        opacities(call.floats(opacities_, "opacities")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")) {
    const int64_t channels = colors.size(-1), images = offsets.size(0), count = opacities.numel();
    const int64_t tile_height = offsets.size(1), tile_width = offsets.size(2), tiles = offsets.numel();
    check(means2d.numel() == 2 * count && conics.numel() == 3 * count && colors.numel() == channels * count,
          "composite: means2d, conics, colors and opacities must be of the same splats");
    check(tile_size > 0 && width >= 0 && height >= 0 && width < kMostInts && height < kMostInts && tile_size < kMostInts &&
              tile_width * tile_size >= width && tile_height * tile_size >= height,
          "composite: the tiles of isect_offsets do not cover the image");
    if (backgrounds_) backgrounds = call.floats(*backgrounds_, "backgrounds");
    if (masks_) {
      check(masks_->numel() == tiles, "composite: masks must have one bool per tile");
      masks = call.take(*masks_, ScalarType::Bool, "masks");
    }
    in = {data(means2d),
          data(conics),
          data(colors),
          data(opacities),
          offsets.const_data_ptr<int32_t>(),
          flatten_ids.const_data_ptr<int32_t>(),
          backgrounds ? data(*backgrounds) : nullptr,
          masks ? masks->const_data_ptr<bool>() : nullptr,
          count,
          flatten_ids.numel(),
          int32_t(images),
          int32_t(channels),
          int32_t(width),
          int32_t(height),
          int32_t(tile_size),
          int32_t(tile_width),
          int32_t(tile_height)};
    check(count < kMostInts && in.instances <= kMostInts && in.tiles() * in.windows() <= kMostInts,
          "composite: more than 2^31 - 1 splats, instances or windows of 16x16 pixels");
  }
};

std::tuple<Tensor, Tensor, Tensor> composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets,
                                             Tensor flatten_ids, std::optional<Tensor> backgrounds, std::optional<Tensor> masks,
                                             std::optional<Tensor> absgrad_probe, int64_t width, int64_t height,
                                             int64_t tile_size) {
  Compositing c(means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height, tile_size);
  Tensor out_colors = c.call.empty({c.in.images, height, width, c.in.channels});
  Tensor alphas = c.call.empty({c.in.images, height, width, 1});
  Tensor last = c.call.empty({c.in.images, height, width}, ScalarType::Int);
  const DevicePixels out = {mutable_data(out_colors), mutable_data(alphas), last.mutable_data_ptr<int32_t>()};
  composite_on_device(c.in, out, c.call, c.call.stream);
  check_cuda(cudaGetLastError(), "composite");
  return {out_colors, alphas, last};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> composite_backward(
    Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets, Tensor flatten_ids,
    std::optional<Tensor> backgrounds, std::optional<Tensor> masks, int64_t width, int64_t height, int64_t tile_size,
    Tensor alphas, Tensor last, Tensor v_colors, Tensor v_alphas, bool absgrad) {
  Compositing c(means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height, tile_size);
  const int64_t count = c.in.count, channels = c.in.channels, images = c.in.images, pixels = images * height * width;
  const Tensor alphas_ = c.call.floats(alphas, "alphas"), last_ = c.call.ints(last, "last");
  const Tensor v_colors_ = c.call.floats(v_colors, "v_colors"), v_alphas_ = c.call.floats(v_alphas, "v_alphas");
  check(alphas_.numel() == pixels && last_.numel() == pixels && v_alphas_.numel() == pixels &&
            v_colors_.numel() == pixels * channels,
        "composite_backward: alphas, last, v_colors and v_alphas must be of the image's size");
  Tensor v_means2d = c.call.empty({count, 2}), v_conics = c.call.empty({count, 3}), v_splats = c.call.empty({count, channels});
  Tensor v_opacities = c.call.empty({count}), v_absolute = c.call.empty({absgrad ? count : 0, 2});
  Tensor v_backgrounds = c.call.empty({backgrounds ? images : 0, channels});
  const DeviceGradients out = {data(alphas_),
                               last_.const_data_ptr<int32_t>(),
                               data(v_colors_),
                               data(v_alphas_),
                               mutable_data(v_means2d),
                               mutable_data(v_conics),
                               mutable_data(v_splats),
                               mutable_data(v_opacities),
                               backgrounds ? mutable_data(v_backgrounds) : nullptr,
                               absgrad ? mutable_data(v_absolute) : nullptr};
  composite_backward_on_device(c.in, out, c.call, c.call.stream);
  check_cuda(cudaGetLastError(), "composite_backward");
  return {v_means2d, v_conics, v_splats, v_opacities, v_backgrounds, v_absolute};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("composite", GSPLAT_BOX(&composite));
  m.impl("composite_backward", GSPLAT_BOX(&composite_backward));
}
