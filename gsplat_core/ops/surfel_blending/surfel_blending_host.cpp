// Host code of blend_surfels and blend_surfels_backward: checks, memory, and the launch on each device.
#include "surfel_blending.h"

#include <tuple>
#include <vector>

#include "../compositing/alpha_limit.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::surfel_blending {
namespace {

constexpr int64_t kMaxInts = (int64_t(1) << 31) - 1;

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means2d, transforms, colors, opacities, normals, offsets, flatten_ids;
  OptionalTensor backgrounds, masks;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d_, const Tensor& transforms_, const Tensor& colors_, const Tensor& opacities_,
            const Tensor& normals_, const Tensor& offsets_, const Tensor& flatten_ids_, const OptionalTensor& backgrounds_,
            const OptionalTensor& masks_, int64_t width, int64_t height, int64_t tile_size, double max_alpha)
      : means2d(call.floats(means2d_, "means2d")),
        transforms(call.floats(transforms_, "ray_transforms")),
        colors(call.floats(colors_, "colors")),
        opacities(call.floats(opacities_, "opacities")),
        normals(call.floats(normals_, "normals")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")),
        backgrounds(call.floats(backgrounds_, "backgrounds")),
        masks(call.take_optional(masks_, ScalarType::Bool, "masks")) {
    check(offsets.dim() == 3 && colors.dim() == 2,
          "blend_surfels: isect_offsets must be [images, tile_height, tile_width] and colors [N, D]");
    const int64_t channels = colors.size(1), images = offsets.size(0), count = opacities.numel();
    const int64_t tile_height = offsets.size(1), tile_width = offsets.size(2);
    check(means2d.numel() == 2 * count && transforms.numel() == 9 * count && colors.size(0) == count &&
              normals.numel() == 3 * count,
          "blend_surfels: means2d, ray_transforms, colors, opacities and normals must be of the same surfels");
    check(channels >= 1 && channels <= kMaxChannels, "blend_surfels: 1 to ", kMaxChannels, " colour channels, found ", channels);
    check(tile_size > 0 && width >= 0 && height >= 0 && width < kMaxInts && height < kMaxInts && tile_size < kMaxInts &&
              tile_width * tile_size >= width && tile_height * tile_size >= height,
          "blend_surfels: the tiles of isect_offsets do not cover the image");
    check(!masks || masks->numel() == offsets.numel(), "blend_surfels: masks must have one bool per tile");
    check(!backgrounds || backgrounds->numel() == images * channels, "blend_surfels: backgrounds must have one colour per image");
    in = {.splats = {.means2d = data(means2d),
                     .conics = nullptr,
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
                     .alpha = compositing::limit_of(max_alpha)},
          .transforms = data(transforms),
          .normals = data(normals)};
    check(count < kMaxInts && in.splats.instances <= kMaxInts && in.splats.tiles() * in.splats.windows() <= kMaxInts,
          "blend_surfels: more than 2^31 - 1 surfels, instances or windows of 16x16 pixels");
  }
};

#if defined(GSPLAT_CUDA)

// CUDA does not check the values of the lists, because the host would have to wait. The kernels clamp positions outside
// of flatten_ids and skip out-of-range surfel indices.
void forward(Call& call, const Inputs& in, const Pixels& out) { blend_on_device(in, out, call, call.stream); }

void backward(Call& call, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  blend_backward_on_device(in, from, out, call, call.stream);
}

#else

// Records, bounds and values of all surfels, and a parallel loop over all tiles.
struct Pass {
  std::unique_ptr<Record[]> records;
  std::unique_ptr<compositing::SplatRecord[]> bounds;
  std::unique_ptr<float[]> values;
  Surfels surfels;

  explicit Pass(const Inputs& in)
      : records(uninitialised<Record>(in.splats.count)),
        bounds(uninitialised<compositing::SplatRecord>(in.splats.count)),
        values(uninitialised<float>(in.splats.count * (kNormal + padded_channels(in.splats.channels)))) {
    compositing::check_lists(in.splats);
    static_cast<Inputs&>(surfels) = in;
    surfels.records = records.get();
    surfels.bounds = bounds.get();
    surfels.values = values.get();
    torch::stable::parallel_for(0, in.splats.count, 2048, [&](int64_t begin, int64_t end) {
      kernels().records(in, begin, end, records.get(), bounds.get(), values.get());
    });
  }
};

void forward(Call&, const Inputs& in, const Pixels& out) {
  const Pass pass(in);
  compositing::for_tiles(in.splats.tiles(), 0, [&](int64_t tile, float*) { kernels().tile(pass.surfels, tile, out); });
}

void backward(Call&, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  const Pass pass(in);
  const bool absgrad = out.absolute != nullptr;
  const int64_t channels = in.splats.channels, tiles = in.splats.tiles();
  const compositing::InstanceRows instances(in.splats, kMoments + kNormal + padded_channels(int(channels)) + (absgrad ? 2 : 0));
  std::vector<float> parts(out.backgrounds != nullptr ? size_t(tiles * channels) : 0, 0.0f);
  const GradientRows rows = {instances.row_of.get(), instances.rows[0].floats, instances.row_size, absgrad,
                             out.backgrounds != nullptr ? parts.data() : nullptr};
  compositing::for_tiles(tiles, 0, [&](int64_t tile, float*) { kernels().tile_backward(pass.surfels, tile, from, rows); });
  torch::stable::parallel_for(0, in.splats.count, 2048, [&](int64_t begin, int64_t end) {
    kernels().gather(pass.surfels, rows, instances.first.get(), begin, end, out);
  });
  for (int64_t image = 0; out.backgrounds != nullptr && image < in.splats.images; ++image) {
    const int64_t per_image = tiles / in.splats.images;
    for (int64_t d = 0; d < channels; ++d) {
      double total = 0;
      for (int64_t tile = image * per_image; tile < (image + 1) * per_image; ++tile) total += parts[size_t(tile * channels + d)];
      out.backgrounds[image * channels + d] = float(total);
    }
  }
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> blend_surfels(
    Tensor means2d, Tensor transforms, Tensor colors, Tensor opacities, Tensor normals, Tensor densify, Tensor offsets,
    Tensor flatten_ids, OptionalTensor backgrounds, OptionalTensor masks, OptionalTensor absgrad_probe, int64_t width,
    int64_t height, int64_t tile_size, double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, transforms, colors, opacities, normals, offsets, flatten_ids, backgrounds, masks,
                            width, height, tile_size, max_alpha);
  const Inputs& in = arguments.in;
  const int64_t images = in.splats.images;
  Tensor out_colors = call.empty({images, height, width, in.splats.channels}), alphas = call.empty({images, height, width, 1});
  Tensor out_normals = call.empty({images, height, width, 3}), distortions = call.empty({images, height, width, 1});
  Tensor medians = call.empty({images, height, width, 1}), depth_sums = call.empty({images, height, width});
  Tensor last = call.empty({images, height, width}, ScalarType::Int);
  Tensor median_at = call.empty({images, height, width}, ScalarType::Int);
  forward(
      call, in,
      {mutable_data(out_colors), mutable_data(alphas), mutable_data(out_normals), mutable_data(distortions),
       mutable_data(medians), mutable_data(depth_sums), last.mutable_data_ptr<int32_t>(), median_at.mutable_data_ptr<int32_t>()});
  call.finish("blend_surfels");
  return {out_colors, alphas, out_normals, distortions, medians, depth_sums, last, median_at};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> blend_surfels_backward(
    Tensor means2d, Tensor transforms, Tensor colors, Tensor opacities, Tensor normals, Tensor offsets, Tensor flatten_ids,
    OptionalTensor backgrounds, OptionalTensor masks, int64_t width, int64_t height, int64_t tile_size, Tensor alphas,
    Tensor depth_sums, Tensor last, Tensor median_at, Tensor v_colors, Tensor v_alphas, Tensor v_normals, Tensor v_distortions,
    Tensor v_medians, bool absgrad, double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, transforms, colors, opacities, normals, offsets, flatten_ids, backgrounds, masks,
                            width, height, tile_size, max_alpha);
  const Inputs& in = arguments.in;
  const int64_t count = in.splats.count, channels = in.splats.channels, pixels = in.splats.images * height * width;
  const Tensor alphas_ = call.floats(alphas, "alphas"), depth_sums_ = call.floats(depth_sums, "depth_sums");
  const Tensor last_ = call.ints(last, "last"), median_at_ = call.ints(median_at, "median_at");
  const Tensor v_colors_ = call.floats(v_colors, "v_colors"), v_alphas_ = call.floats(v_alphas, "v_alphas");
  const Tensor v_normals_ = call.floats(v_normals, "v_normals"), v_medians_ = call.floats(v_medians, "v_medians");
  const Tensor v_distortions_ = call.floats(v_distortions, "v_distortions");
  check(alphas_.numel() == pixels && depth_sums_.numel() == pixels && last_.numel() == pixels && median_at_.numel() == pixels &&
            v_colors_.numel() == pixels * channels && v_alphas_.numel() == pixels && v_normals_.numel() == pixels * 3 &&
            v_distortions_.numel() == pixels && v_medians_.numel() == pixels,
        "blend_surfels_backward: results and gradients must be of the image's size");
  Tensor v_means2d = call.empty({count, 2}), v_transforms = call.empty({count, 3, 3}), v_surfels = call.empty({count, channels});
  Tensor v_opacities = call.empty({count}), v_axes = call.empty({count, 3}), v_densify = call.empty({count, 2});
  Tensor v_backgrounds = call.empty({backgrounds ? in.splats.images : 0, channels});
  Tensor v_absolute = call.empty({absgrad ? count : 0, 2});
  backward(call, in,
           {data(alphas_), data(depth_sums_), last_.const_data_ptr<int32_t>(), median_at_.const_data_ptr<int32_t>(),
            data(v_colors_), data(v_alphas_), data(v_normals_), data(v_distortions_), data(v_medians_)},
           {mutable_data(v_means2d), mutable_data(v_transforms), mutable_data(v_surfels), mutable_data(v_opacities),
            mutable_data(v_axes), mutable_data(v_densify), backgrounds ? mutable_data(v_backgrounds) : nullptr,
            absgrad ? mutable_data(v_absolute) : nullptr});
  call.finish("blend_surfels_backward");
  return {v_means2d, v_transforms, v_surfels, v_opacities, v_axes, v_densify, v_backgrounds, v_absolute};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("blend_surfels", GSPLAT_BOX(&blend_surfels));
  m.impl("blend_surfels_backward", GSPLAT_BOX(&blend_surfels_backward));
}

}  // namespace gsplat::surfel_blending
