// Host code of blend_rays and blend_rays_backward: checks, memory, and the launch on each device.
#include "ray_blending.h"

#include <tuple>

#include "../compositing/alpha_limit.h"
#include "../compositing/tiled_splats.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::ray_blending {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  compositing::TiledSplats splats;
  Tensor rays, values;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d, const Tensor& conics, const Tensor& opacities, const Tensor& rays_,
            const Tensor& values_, const Tensor& offsets, const Tensor& flatten_ids, int64_t width, int64_t height,
            double max_alpha)
      : splats(call, "blend_rays", means2d, conics, opacities, offsets, flatten_ids, width, height,
               compositing::limit_of(max_alpha)),
        rays(call.floats(rays_, "rays")),
        values(call.floats(values_, "values")) {
    check(values.dim() == 2 && values.size(0) == splats.in.count, "blend_rays: values must be [", splats.in.count, ", D]");
    splats.check_rows("blend_rays", "rays", rays, kRayNumbers);
    const int64_t channels = values.size(1);
    check(channels <= kMaxChannels, "blend_rays: at most ", kMaxChannels, " channels, found ", channels);
    in = {.splats = splats.in, .rays = data(rays), .values = data(values), .channels = int32_t(channels)};
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
