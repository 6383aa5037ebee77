// Host code of blend_world and blend_world_backward: checks, memory, and the launch on each device.
#include "world_blending.h"

#include <tuple>

#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::world_blending {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor gaussians, colors, opacities, rays, offsets, flatten_ids;
  OptionalTensor masks;
  Inputs in = {};

  Arguments(const Call& call, const Tensor& gaussians_, const Tensor& colors_, const Tensor& opacities_, const Tensor& rays_,
            const Tensor& offsets_, const Tensor& flatten_ids_, const OptionalTensor& masks_, int64_t tile_size, double max_alpha)
      : gaussians(call.floats(gaussians_, "gaussians")),
        colors(call.floats(colors_, "colors")),
        opacities(call.floats(opacities_, "opacities")),
        rays(call.floats(rays_, "rays")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")),
        masks(call.take_optional(masks_, ScalarType::Bool, "masks")) {
    check(gaussians.dim() == 3 && colors.dim() == 3 && opacities.dim() == 2 && rays.dim() == 4 && offsets.dim() == 3 &&
              flatten_ids.dim() == 1,
          "blend_world takes gaussians [B, N, 12], colors [I, N, D], opacities [I, N], rays [I, H, W, 6], isect_offsets [I, th, "
          "tw] and flatten_ids [M]");
    const int64_t B = gaussians.size(0), N = gaussians.size(1), I = rays.size(0), H = rays.size(1), W = rays.size(2),
                  D = colors.size(2), th = offsets.size(1), tw = offsets.size(2);
    constexpr int64_t most = (int64_t(1) << 31) - 1;
    check(gaussians.size(2) == kGaussianNumbers && rays.size(3) == kRayNumbers && colors.size(0) == I && colors.size(1) == N &&
              opacities.size(0) == I && opacities.size(1) == N && offsets.size(0) == I && (I == 0 || (B > 0 && I % B == 0)) &&
              (!masks.has_value() || masks->numel() == offsets.numel()),
          "blend_world: the sizes of the inputs do not fit together for ", B, " batches, ", I, " images and ", N, " Gaussians");
    check(tile_size > 0 && th * tile_size >= H && tw * tile_size >= W && I * N < most && I * th * tw <= most && H <= most &&
              W <= most && D <= most && flatten_ids.numel() <= most,
          "blend_world: ", tw, " x ", th, " tiles of ", tile_size, " px do not cover the image of ", W, " x ", H, " px");
    in.gaussians = data(gaussians), in.colors = data(colors), in.opacities = data(opacities), in.rays = data(rays);
    in.offsets = offsets.const_data_ptr<int32_t>(), in.flatten_ids = flatten_ids.const_data_ptr<int32_t>();
    in.masks = masks.has_value() ? static_cast<const bool*>(masks->const_data_ptr()) : nullptr;
    in.count = N, in.instances = flatten_ids.numel();
    in.images = int32_t(I), in.cameras = int32_t(B > 0 && I >= B ? I / B : 1), in.channels = int32_t(D);
    in.width = int32_t(W), in.height = int32_t(H), in.tile_size = int32_t(tile_size);
    in.tile_width = int32_t(tw), in.tile_height = int32_t(th), in.max_alpha = float(max_alpha);
  }
};

#if defined(GSPLAT_CUDA)

// CUDA does not check the values of the lists, because the host would have to wait. The kernels clamp positions outside
// of flatten_ids and skip indices out of range.
void blend(const Call& call, const Inputs& in, const Pixels& out) { blend_on_device(in, out, call.stream); }

void backward(Call& call, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  blend_backward_on_device(in, from, out, call, call.stream);
}

#else

compositing::Inputs lists_of(const Inputs& in) {
  compositing::Inputs lists = {};
  lists.offsets = in.offsets, lists.flatten_ids = in.flatten_ids;
  lists.count = in.count * in.images, lists.instances = in.instances;
  lists.images = in.images, lists.tile_width = in.tile_width, lists.tile_height = in.tile_height;
  compositing::check_lists(lists);
  return lists;
}

void blend(const Call&, const Inputs& in, const Pixels& out) {
  compositing::for_tiles(lists_of(in).tiles(), int64_t(in.channels) * kMostLanes,
                         [&](int64_t tile, float* scratch) { kernels().tile(in, tile, out, scratch); });
}

void backward(Call&, const Inputs& in, const PixelGradients& from, const InputGradients& out) {
  const compositing::Inputs lists = lists_of(in);
  const compositing::InstanceRows instances(lists, kMoments + in.channels);
  const GradientRows rows = {instances.row_of.get(), instances.rows[0].floats, instances.row_size, out.rays};
  compositing::for_tiles(lists.tiles(), backward_scratch(in.channels),
                         [&](int64_t tile, float* scratch) { kernels().tile_backward(in, tile, from, rows, scratch); });
  torch::stable::parallel_for(0, lists.count, 2048, [&](int64_t begin, int64_t end) {
    kernels().gather(in, rows, instances.first.get(), begin, end, out);
  });
}

#endif

std::tuple<Tensor, Tensor, Tensor> blend_world(Tensor gaussians, Tensor colors, Tensor opacities, Tensor rays, Tensor offsets,
                                               Tensor flatten_ids, OptionalTensor masks, int64_t tile_size, double max_alpha) {
  const Call call(gaussians);
  const Arguments arguments(call, gaussians, colors, opacities, rays, offsets, flatten_ids, masks, tile_size, max_alpha);
  const Inputs& in = arguments.in;
  Tensor image = call.empty({in.images, in.height, in.width, in.channels}),
         through = call.empty({in.images, in.height, in.width, 1});
  Tensor last = call.empty({in.images, in.height, in.width}, ScalarType::Int);
  blend(call, in, {mutable_data(image), mutable_data(through), last.mutable_data_ptr<int32_t>()});
  call.finish("blend_world");
  return {image, through, last};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> blend_world_backward(Tensor gaussians, Tensor colors, Tensor opacities, Tensor rays,
                                                                Tensor offsets, Tensor flatten_ids, OptionalTensor masks,
                                                                int64_t tile_size, double max_alpha, Tensor through_,
                                                                Tensor last_, Tensor v_image_, Tensor v_through_) {
  Call call(gaussians);
  const Arguments arguments(call, gaussians, colors, opacities, rays, offsets, flatten_ids, masks, tile_size, max_alpha);
  const Inputs& in = arguments.in;
  const Tensor through = call.floats(through_, "through"), last = call.ints(last_, "last");
  const Tensor v_image = call.floats(v_image_, "v_colors"), v_through = call.floats(v_through_, "v_through");
  const int64_t pixels = int64_t(in.images) * in.height * in.width;
  check(through.numel() == pixels && last.numel() == pixels && v_through.numel() == pixels &&
            v_image.numel() == pixels * in.channels,
        "blend_world_backward: results and gradients must be of the image's size");
  Tensor v_gaussians = call.empty({in.images, in.count, kGaussianNumbers});
  Tensor v_colors = call.empty({in.images, in.count, in.channels}), v_opacities = call.empty({in.images, in.count});
  Tensor v_rays = call.empty({in.images, in.height, in.width, kRayNumbers});
  backward(call, in, {data(through), last.const_data_ptr<int32_t>(), data(v_image), data(v_through)},
           {mutable_data(v_gaussians), mutable_data(v_colors), mutable_data(v_opacities), mutable_data(v_rays)});
  call.finish("blend_world_backward");
  return {v_gaussians, v_colors, v_opacities, v_rays};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("blend_world", GSPLAT_BOX(&blend_world));
  m.impl("blend_world_backward", GSPLAT_BOX(&blend_world_backward));
}

}  // namespace gsplat::world_blending
