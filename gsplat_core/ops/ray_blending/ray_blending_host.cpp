// Host code of blend_rays and blend_rays_backward: checks, memory, and the launch on each device.
#include "ray_blending.h"

#include <tuple>

#include "../compositing/alpha_limit.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::ray_blending {
namespace {

constexpr int64_t kMaxInts = (int64_t(1) << 31) - 1;

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means2d, conics, opacities, rays, values, offsets, flatten_ids;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d_, const Tensor& conics_, const Tensor& opacities_, const Tensor& rays_,
            const Tensor& values_, const Tensor& offsets_, const Tensor& flatten_ids_, int64_t width, int64_t height,
            double max_alpha)
      : means2d(call.floats(means2d_, "means2d")),
        conics(call.floats(conics_, "conics")),
        opacities(call.floats(opacities_, "opacities")),
        rays(call.floats(rays_, "rays")),
        values(call.floats(values_, "values")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")) {
    check(offsets.dim() == 2 && values.dim() == 2,
          "blend_rays: isect_offsets must be [tile_height, tile_width] and values [N, D]");
    const int64_t count = opacities.numel(), channels = values.size(1);
    const int64_t tile_height = offsets.size(0), tile_width = offsets.size(1);
    check(means2d.numel() == 2 * count && conics.numel() == 3 * count && rays.numel() == kRayNumbers * count &&
              values.size(0) == count,
          "blend_rays: means2d, conics, opacities, rays and values must be of the same splats");
    check(channels <= kMaxChannels, "blend_rays: at most ", kMaxChannels, " channels, found ", channels);
    check(width >= 0 && height >= 0 && tile_width * kTileSize >= width && tile_height * kTileSize >= height &&
              tile_width * tile_height < kMaxInts,
          "blend_rays: the tiles of isect_offsets do not cover the image");
    check(count < kMaxInts && flatten_ids.numel() <= kMaxInts, "blend_rays: more than 2^31 - 1 splats or instances");
    in = {.splats = {.means2d = data(means2d),
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
                     .alpha = compositing::limit_of(max_alpha)},
          .rays = data(rays),
          .values = data(values),
          .channels = int32_t(channels)};
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Inputs& in, const Pixels& out) { blend_on_device(in, out, call, call.stream); }

void raise_contributions(Call& call, const Inputs& in, float* most) {
  contributions_on_device(in.splats, most, call, call.stream);
}

void backward(Call& call, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  blend_backward_on_device(in, from, out, call, call.stream);
}

#else

std::unique_ptr<compositing::SplatRecord[]> records_of(const Inputs& in) {
  compositing::check_lists(in.splats);
  auto records = uninitialised<compositing::SplatRecord>(in.splats.count);
  torch::stable::parallel_for(0, in.splats.count, 2048,
                              [&](int64_t begin, int64_t end) { kernels().records(in, begin, end, records.get()); });
  return records;
}

void forward(Call&, const Inputs& in, const Pixels& out) {
  const auto records = records_of(in);
  compositing::for_tiles(in.splats.tiles(), 0, [&](int64_t tile, float*) { kernels().tile(in, records.get(), tile, out); });
}

void backward(Call&, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  const auto records = records_of(in);
  const compositing::InstanceRows instances(in.splats, kMoments + kRaySums + in.channels);
  const GradientRows rows = {instances.row_of.get(), instances.rows[0].floats, instances.row_size};
  compositing::for_tiles(in.splats.tiles(), 0,
                         [&](int64_t tile, float*) { kernels().tile_backward(in, records.get(), tile, from, rows); });
  torch::stable::parallel_for(0, in.splats.count, 2048, [&](int64_t begin, int64_t end) {
    kernels().gather(in, records.get(), rows, instances.first.get(), begin, end, out);
  });
}

void raise_contributions(Call&, const Inputs& in, float* most) {
  const auto records = records_of(in);
  compositing::Splats splats;
  static_cast<compositing::Inputs&>(splats) = in.splats;
  splats.records = records.get();
  compositing::for_tiles(in.splats.tiles(), 0, [&](int64_t tile, float*) { kernels().contributions(splats, tile, most); });
}

#endif

Tensor splat_contributions(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor values, Tensor offsets,
                           Tensor flatten_ids, int64_t width, int64_t height, double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, opacities, rays, values, offsets, flatten_ids, width, height, max_alpha);
  Tensor most = call.zeros({arguments.in.splats.count});
  raise_contributions(call, arguments.in, mutable_data(most));
  call.finish("splat_contributions");
  return most;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> blend_rays(Tensor means2d, Tensor conics, Tensor opacities,
                                                                              Tensor rays, Tensor values, Tensor offsets,
                                                                              Tensor flatten_ids, int64_t width, int64_t height,
                                                                              double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, opacities, rays, values, offsets, flatten_ids, width, height, max_alpha);
  const Inputs& in = arguments.in;
  Tensor out_values = call.empty({height, width, in.channels}), alphas = call.empty({height, width});
  Tensor depths = call.empty({height, width}), medians = call.empty({height, width}), variances = call.empty({height, width});
  Tensor last = call.empty({height, width}, ScalarType::Int), median_at = call.empty({height, width}, ScalarType::Int);
  forward(call, in,
          {mutable_data(out_values), mutable_data(alphas), mutable_data(depths), mutable_data(medians), mutable_data(variances),
           last.mutable_data_ptr<int32_t>(), median_at.mutable_data_ptr<int32_t>()});
  call.finish("blend_rays");
  return {out_values, alphas, depths, medians, variances, last, median_at};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> blend_rays_backward(Tensor means2d, Tensor conics, Tensor opacities,
                                                                       Tensor rays, Tensor values, Tensor offsets,
                                                                       Tensor flatten_ids, int64_t width, int64_t height,
                                                                       Tensor alphas, Tensor depths, Tensor last,
                                                                       Tensor median_at, Tensor v_values, Tensor v_alphas,
                                                                       Tensor v_depths, Tensor v_medians, double max_alpha) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, opacities, rays, values, offsets, flatten_ids, width, height, max_alpha);
  const Inputs& in = arguments.in;
  const int64_t count = in.splats.count, pixels = height * width;
  const Tensor alphas_ = call.floats(alphas, "alphas"), depths_ = call.floats(depths, "depths");
  const Tensor last_ = call.ints(last, "last"), median_at_ = call.ints(median_at, "median_at");
  const Tensor v_values_ = call.floats(v_values, "v_values"), v_alphas_ = call.floats(v_alphas, "v_alphas");
  const Tensor v_depths_ = call.floats(v_depths, "v_depths"), v_medians_ = call.floats(v_medians, "v_medians");
  check(alphas_.numel() == pixels && depths_.numel() == pixels && last_.numel() == pixels && median_at_.numel() == pixels &&
            v_alphas_.numel() == pixels && v_depths_.numel() == pixels && v_medians_.numel() == pixels &&
            v_values_.numel() == pixels * in.channels,
        "blend_rays_backward: results and gradients must be of the image's size");
  Tensor v_means2d = call.empty({count, 2}), v_conics = call.empty({count, 3}), v_opacities = call.empty({count});
  Tensor v_rays = call.empty({count, kRayNumbers}), v_splats = call.empty({count, in.channels});
  backward(
      call, in,
      {data(alphas_), data(depths_), last_.const_data_ptr<int32_t>(), median_at_.const_data_ptr<int32_t>(), data(v_values_),
       data(v_alphas_), data(v_depths_), data(v_medians_)},
      {mutable_data(v_means2d), mutable_data(v_conics), mutable_data(v_opacities), mutable_data(v_rays), mutable_data(v_splats)});
  call.finish("blend_rays_backward");
  return {v_means2d, v_conics, v_opacities, v_rays, v_splats};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("blend_rays", GSPLAT_BOX(&blend_rays));
  m.impl("splat_contributions", GSPLAT_BOX(&splat_contributions));
  m.impl("blend_rays_backward", GSPLAT_BOX(&blend_rays_backward));
}

}  // namespace gsplat::ray_blending
