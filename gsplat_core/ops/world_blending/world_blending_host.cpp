// Host code of blend_world: checks, memory, and the launch on each device.
#include "world_blending.h"

#include <tuple>

#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::world_blending {
namespace {

#if defined(GSPLAT_CUDA)

void blend(const Call& call, const Inputs& in, const Pixels& out) { blend_on_device(in, out, call.stream); }

#else

void blend(const Call&, const Inputs& in, const Pixels& out) {
  compositing::Inputs lists = {};
  lists.offsets = in.offsets, lists.flatten_ids = in.flatten_ids;
  lists.count = in.count * in.images, lists.instances = in.instances;
  lists.images = in.images, lists.tile_width = in.tile_width, lists.tile_height = in.tile_height;
  compositing::check_lists(lists);
  compositing::for_tiles(lists.tiles(), int64_t(in.channels) * kMostLanes,
                         [&](int64_t tile, float* scratch) { kernels().tile(in, tile, out, scratch); });
}

#endif

std::tuple<Tensor, Tensor> blend_world(Tensor gaussians_, Tensor colors_, Tensor opacities_, Tensor rays_, Tensor offsets_,
                                       Tensor flatten_ids_, OptionalTensor masks_, int64_t tile_size, double max_alpha) {
  const Call call(gaussians_);
  const Tensor gaussians = call.floats(gaussians_, "gaussians"), colors = call.floats(colors_, "colors"),
               opacities = call.floats(opacities_, "opacities"), rays = call.floats(rays_, "rays"),
               offsets = call.ints(offsets_, "isect_offsets"), flatten_ids = call.ints(flatten_ids_, "flatten_ids");
  OptionalTensor masks;
  if (masks_.has_value()) masks = call.take(*masks_, ScalarType::Bool, "masks");
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
  check(tile_size > 0 && th * tile_size >= H && tw * tile_size >= W && I * N <= most && I * th * tw <= most && H <= most &&
            W <= most && D <= most && flatten_ids.numel() <= most,
        "blend_world: ", tw, " x ", th, " tiles of ", tile_size, " px do not cover the image of ", W, " x ", H, " px");
  Inputs in = {};
  in.gaussians = data(gaussians), in.colors = data(colors), in.opacities = data(opacities), in.rays = data(rays);
  in.offsets = offsets.const_data_ptr<int32_t>(), in.flatten_ids = flatten_ids.const_data_ptr<int32_t>();
  in.masks = masks.has_value() ? static_cast<const bool*>(masks->const_data_ptr()) : nullptr;
  in.count = N, in.instances = flatten_ids.numel();
  in.images = int32_t(I), in.cameras = int32_t(B > 0 && I >= B ? I / B : 1), in.channels = int32_t(D);
  in.width = int32_t(W), in.height = int32_t(H), in.tile_size = int32_t(tile_size);
  in.tile_width = int32_t(tw), in.tile_height = int32_t(th), in.max_alpha = float(max_alpha);
  Tensor image = call.empty({I, H, W, D}), through = call.empty({I, H, W, 1});
  blend(call, in, {mutable_data(image), mutable_data(through)});
  call.finish("blend_world");
  return {image, through};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("blend_world", GSPLAT_BOX(&blend_world)); }

}  // namespace gsplat::world_blending
