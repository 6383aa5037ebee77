// Host code of composite and composite_backward: checks, memory, and the launch on each device.
#include <tuple>
#include <vector>

#include "alpha_limit.h"
#include "compositing.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "tile_pass.h"
#endif

namespace gsplat::compositing {
namespace {

constexpr int64_t kMaxInts = (int64_t(1) << 31) - 1;

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means2d, conics, colors, opacities, offsets, flatten_ids;
  OptionalTensor backgrounds, masks;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d_, const Tensor& conics_, const Tensor& colors_, const Tensor& opacities_,
            const Tensor& offsets_, const Tensor& flatten_ids_, const OptionalTensor& backgrounds_, const OptionalTensor& masks_,
            int64_t width, int64_t height, int64_t tile_size, double max_alpha)
      : means2d(call.floats(means2d_, "means2d")),
        conics(call.floats(conics_, "conics")),
        colors(call.floats(colors_, "colors")),
        opacities(call.floats(opacities_, "opacities")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")),
        backgrounds(call.floats(backgrounds_, "backgrounds")),
        masks(call.take_optional(masks_, ScalarType::Bool, "masks")) {
    check(offsets.dim() == 3 && colors.dim() == 2,
          "composite: isect_offsets must be [images, tile_height, tile_width] and colors [N, D]");
    const int64_t channels = colors.size(1), images = offsets.size(0), count = opacities.numel();
    const int64_t tile_height = offsets.size(1), tile_width = offsets.size(2);
    check(means2d.numel() == 2 * count && conics.numel() == 3 * count && colors.numel() == channels * count,
          "composite: means2d, conics, colors and opacities must be of the same splats");
    check(tile_size > 0 && width >= 0 && height >= 0 && width < kMaxInts && height < kMaxInts && tile_size < kMaxInts &&
              tile_width * tile_size >= width && tile_height * tile_size >= height,
          "composite: the tiles of isect_offsets do not cover the image");
    check(!masks || masks->numel() == offsets.numel(), "composite: masks must have one bool per tile");
    in = {.means2d = data(means2d),
          .conics = data(conics),
          .colors = data(colors),
          .opacities = data(opacities),
          .offsets = offsets.const_data_ptr<int32_t>(),
          .flatten_ids = flatten_ids.const_data_ptr<int32_t>(),
          .backgrounds = data(backgrounds),
          .masks = masks ? masks->const_data_ptr<bool>() : nullptr,
          .count = count,
          .instances = flatten_ids.numel(),
          .images = int32_t(images),
          .channels = int32_t(channels),
          .width = int32_t(width),
          .height = int32_t(height),
          .tile_size = int32_t(tile_size),
          .tile_width = int32_t(tile_width),
          .tile_height = int32_t(tile_height),
          .alpha = limit_of(max_alpha)};
  }
};

#if defined(GSPLAT_CUDA)

// CUDA does not check the values of the lists, because the host would have to wait. The kernels clamp positions outside
// of flatten_ids and skip out-of-range splat indices.
void check_sizes(const Inputs& in) {
  check(in.count < kMaxInts && in.instances <= kMaxInts && in.tiles() * in.windows() <= kMaxInts,
        "composite: more than 2^31 - 1 splats, instances or windows of 16x16 pixels");
}

void forward(Call& call, const Inputs& in, const Pixels& out) {
  check_sizes(in);
  composite_on_device(in, out, call, call.stream);
}

void backward(Call& call, const Inputs& in, const PictureGradient& from, const InputGradients& out) {
  check_sizes(in);
  composite_backward_on_device(in, from, out, call, call.stream);
}

#else

// Records of all splats, and a parallel loop over all tiles.
struct Pass {
  std::unique_ptr<SplatRecord[]> records;
  Splats splats;

  explicit Pass(const Inputs& in) {
    check_lists(in);
    records = uninitialised<SplatRecord>(in.count);
    splats = {in, records.get()};
    torch::stable::parallel_for(0, in.count, 2048,
                                [&](int64_t begin, int64_t end) { kernels().records(in, begin, end, records.get()); });
  }

  template <class Run>
  void for_all_tiles(const Run& run) const {
    for_tiles(splats.tiles(), kernels().scratch_floats(splats.channels), run);
  }
};

void forward(Call&, const Inputs& in, const Pixels& out) {
  const Pass pass(in);
  pass.for_all_tiles([&](int64_t tile, float* scratch) { kernels().tile(pass.splats, tile, out, scratch); });
}

void backward(Call&, const Inputs& in, const PictureGradient& from, const InputGradients& out) {
  const Pass pass(in);
  const bool absgrad = out.absolute != nullptr;
  const int64_t channels = in.channels;
  const InstanceRows instances(in, kMoments + channels + (absgrad ? 2 : 0));
  std::vector<float> background_parts(out.backgrounds != nullptr ? size_t(in.tiles() * channels) : 0, 0.0f);
  const GradientRows gradients = {instances.row_of.get(), instances.rows[0].floats, instances.row_size, absgrad,
                                  out.backgrounds != nullptr ? background_parts.data() : nullptr};
  pass.for_all_tiles([&](int64_t tile, float* scratch) { kernels().tile_backward(pass.splats, tile, from, gradients, scratch); });
  torch::stable::parallel_for(0, in.count, 2048, [&](int64_t begin, int64_t end) {
    kernels().gather(pass.splats, gradients, instances.first.get(), begin, end, out);
  });
  for (int64_t image = 0; out.backgrounds != nullptr && image < in.images; ++image) {
    const int64_t tiles = in.tiles() / in.images;
    for (int64_t d = 0; d < channels; ++d) {
      double total = 0;
      for (int64_t tile = image * tiles; tile < (image + 1) * tiles; ++tile)
        total += background_parts[size_t(tile * channels + d)];
      out.backgrounds[image * channels + d] = float(total);
    }
  }
}

#endif

std::tuple<Tensor, Tensor, Tensor> composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets,
                                             Tensor flatten_ids, OptionalTensor backgrounds, OptionalTensor masks,
                                             OptionalTensor absgrad_probe, int64_t width, int64_t height, int64_t tile_size,
                                             double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height,
                            tile_size, max_alpha);
  const Inputs& in = arguments.in;
  Tensor out_colors = call.empty({in.images, height, width, in.channels}), alphas = call.empty({in.images, height, width, 1});
  Tensor last = call.empty({in.images, height, width}, ScalarType::Int);
  forward(call, in, {mutable_data(out_colors), mutable_data(alphas), last.mutable_data_ptr<int32_t>()});
  call.finish("composite");
  return {out_colors, alphas, last};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> composite_backward(
    Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor offsets, Tensor flatten_ids,
    OptionalTensor backgrounds, OptionalTensor masks, int64_t width, int64_t height, int64_t tile_size, Tensor alphas,
    Tensor last, Tensor v_colors, Tensor v_alphas, bool absgrad, double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, colors, opacities, offsets, flatten_ids, backgrounds, masks, width, height,
                            tile_size, max_alpha);
  const Inputs& in = arguments.in;
  const int64_t count = in.count, channels = in.channels, pixels = in.images * height * width;
  const Tensor alphas_ = call.floats(alphas, "alphas"), last_ = call.ints(last, "last");
  const Tensor v_colors_ = call.floats(v_colors, "v_colors"), v_alphas_ = call.floats(v_alphas, "v_alphas");
  check(alphas_.numel() == pixels && last_.numel() == pixels && v_alphas_.numel() == pixels &&
            v_colors_.numel() == pixels * channels,
        "composite_backward: alphas, last, v_colors and v_alphas must be of the image's size");
  Tensor v_means2d = call.empty({count, 2}), v_conics = call.empty({count, 3}), v_splats = call.empty({count, channels});
  Tensor v_opacities = call.empty({count}), v_absolute = call.empty({absgrad ? count : 0, 2});
  Tensor v_backgrounds = call.empty({backgrounds ? in.images : 0, channels});
  const PictureGradient from = {data(alphas_), last_.const_data_ptr<int32_t>(), data(v_colors_), data(v_alphas_)};
  const InputGradients out = {mutable_data(v_means2d),
                              mutable_data(v_conics),
                              mutable_data(v_splats),
                              mutable_data(v_opacities),
                              backgrounds ? mutable_data(v_backgrounds) : nullptr,
                              absgrad ? mutable_data(v_absolute) : nullptr};
  backward(call, in, from, out);
  call.finish("composite_backward");
  return {v_means2d, v_conics, v_splats, v_opacities, v_backgrounds, v_absolute};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("composite", GSPLAT_BOX(&composite));
  m.impl("composite_backward", GSPLAT_BOX(&composite_backward));
}

}  // namespace gsplat::compositing
