// Host code of surface_path: checks, memory, and the launch on each device.
#include "host_call.h"
#include "surface_motion.h"

namespace gsplat::surface_motion {
namespace {

#if defined(GSPLAT_CUDA)

void follow(const Call& call, const Flows& flows, const float* points, float* positions, int64_t count) {
  path_on_device(flows, points, positions, count, call.stream);
}

#else

constexpr int64_t kGrain = 256;  // minimum points per task

void follow(const Call&, const Flows& flows, const float* points, float* positions, int64_t count) {
  torch::stable::parallel_for(0, count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().path(flows, points, positions, begin, end); });
}

#endif

Tensor surface_path(Tensor points, Tensor flows, Tensor views) {
  const Call call(points);
  const Tensor at = call.floats(points, "points"), cells = call.floats(flows, "flows"), cameras = call.floats(views, "views");
  check(at.dim() == 2 && at.size(1) == 3, "points must be [N, 3]");
  check(cells.dim() == 4 && cells.size(3) == 2 && cells.size(1) > 0 && cells.size(2) > 0,
        "flows must be [T, h, w, 2] with at least one cell");
  const int64_t steps = cells.size(0);
  check(cameras.dim() == 2 && cameras.size(0) == steps + 1 && cameras.size(1) == kViewNumbers, "views must be [", steps + 1, ", ",
        kViewNumbers, "]");
  Tensor positions = call.empty({at.size(0), steps, 3});
  if (positions.numel() > 0) {
    const Flows all = {data(cells), data(cameras), steps, cells.size(1), cells.size(2)};
    follow(call, all, data(at), mutable_data(positions), at.size(0));
  }
  call.finish("surface_path");
  return positions;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("surface_path", GSPLAT_BOX(&surface_path)); }

}  // namespace gsplat::surface_motion
