// Host code of blend_flow and blend_flow_backward: checks, memory, and the launch on each device.
#include "flow_blending.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../compositing/tiled_splats.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::flow_blending {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  compositing::TiledSplats splats;
  Tensor rays, planes;
  Inputs in = {};

  Arguments(const Call& call, const Tensor& means2d, const Tensor& conics, const Tensor& opacities, const Tensor& rays_,
            const Tensor& planes_, const Tensor& offsets, const Tensor& flatten_ids, const std::vector<double>& intrinsics,
            int64_t width, int64_t height)
      : splats(call, "blend_flow", means2d, conics, opacities, offsets, flatten_ids, width, height),
        rays(call.floats(rays_, "rays")),
        planes(call.floats(planes_, "planes")) {
    splats.check_rows("blend_flow", "rays", rays, kRayNumbers);
    splats.check_rows("blend_flow", "planes", planes, kPlaneNumbers);
    check(intrinsics.size() == 8, "blend_flow: intrinsics must be fx, fy, cx, cy of both cameras");
    const auto pinhole = [&](size_t first) {
      const Pinhole p = {float(intrinsics[first]), float(intrinsics[first + 1]), float(intrinsics[first + 2]),
                         float(intrinsics[first + 3])};
      check(p.fx > 0 && p.fy > 0, "blend_flow: focal lengths must be positive");
      return p;
    };
    static_cast<compositing::Inputs&>(in) = splats.in;
    in.rays = data(rays);
    in.planes = data(planes);
    in.before = pinhole(0);
    in.after = pinhole(4);
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Inputs& in, float* out) { blend_on_device(in, out, call, call.stream); }

void backward(Call& call, const Inputs& in, const float* v_out, float* v_planes) {
  blend_backward_on_device(in, v_out, v_planes, call, call.stream);
}

#else

bool all_finite(const float* values, int count) {
  float zero = 0;
  for (int i = 0; i < count; ++i) zero += 0 * values[i];
  return zero == 0;
}

// Records of all splats, which the tiles are blended from.
struct Pass {
  std::unique_ptr<compositing::SplatRecord[]> records;
  Splats splats;

  explicit Pass(const Inputs& in) : records(uninitialised<compositing::SplatRecord>(in.count)), splats{in, {in, records.get()}} {
    compositing::check_lists(in);
    torch::stable::parallel_for(0, in.count, 2048, [&](int64_t begin, int64_t end) {
      compositing::kernels().records(in, begin, end, records.get());
      // A splat with a non-finite value reaches no pixel.
      for (int64_t i = begin; i < end; ++i)
        if (!all_finite(in.rays + i * kRayNumbers, kRayNumbers) || !all_finite(in.planes + i * kPlaneNumbers, kPlaneNumbers))
          records[size_t(i)].l = -INFINITY;
    });
  }
};

void forward(Call&, const Inputs& in, float* out) {
  const Pass pass(in);
  compositing::for_tiles(in.tiles(), 0, [&](int64_t tile, float*) { kernels().tile(pass.splats, tile, out); });
}

void backward(Call&, const Inputs& in, const float* v_out, float* v_planes) {
  const Pass pass(in);
  const compositing::InstanceRows instances(in, kPlaneNumbers);
  const GradientRows rows = {instances.row_of.get(), instances.rows[0].floats, instances.row_size};
  compositing::for_tiles(in.tiles(), 0, [&](int64_t tile, float*) { kernels().tile_backward(pass.splats, tile, v_out, rows); });
  torch::stable::parallel_for(0, in.count, 2048, [&](int64_t begin, int64_t end) {
    for (int64_t splat = begin; splat < end; ++splat) {
      float* const to = v_planes + splat * kPlaneNumbers;
      std::fill(to, to + kPlaneNumbers, 0.0f);
      for (int64_t row = instances.first[size_t(splat)]; row < instances.first[size_t(splat) + 1]; ++row)
        for (int k = 0; k < kPlaneNumbers; ++k) to[k] += rows.rows[row * rows.row_size + k];
    }
  });
}

#endif

Tensor blend_flow(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor planes, Tensor offsets, Tensor flatten_ids,
                  std::vector<double> intrinsics, int64_t width, int64_t height) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, opacities, rays, planes, offsets, flatten_ids, intrinsics, width, height);
  Tensor out = call.empty({height, width, kChannels});
  forward(call, arguments.in, mutable_data(out));
  call.finish("blend_flow");
  return out;
}

Tensor blend_flow_backward(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor planes, Tensor offsets,
                           Tensor flatten_ids, std::vector<double> intrinsics, int64_t width, int64_t height, Tensor v_out) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, opacities, rays, planes, offsets, flatten_ids, intrinsics, width, height);
  const Tensor v = call.floats(v_out, "v_out");
  check(v.numel() == width * height * kChannels, "blend_flow_backward: v_out must be [height, width, ", kChannels, "]");
  Tensor v_planes = call.empty({arguments.in.count, kPlaneNumbers});
  backward(call, arguments.in, data(v), mutable_data(v_planes));
  call.finish("blend_flow_backward");
  return v_planes;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("blend_flow", GSPLAT_BOX(&blend_flow));
  m.impl("blend_flow_backward", GSPLAT_BOX(&blend_flow_backward));
}

}  // namespace gsplat::flow_blending
