#include <vector>

#include "host_call.h"
#include "surface_motion.h"

namespace gsplat::surface_motion {
namespace {

constexpr int64_t kGrain = 2048;  // minimum points per task

View checked_view(const std::vector<double>& numbers, const char* name) {
  check(int64_t(numbers.size()) == kViewNumbers, name, " must have ", kViewNumbers, " numbers, got ", numbers.size());
  const View v = view_of(numbers.data());
  check(v.fx > 0 && v.fy > 0 && v.width > 0 && v.height > 0, name, " must have positive focal lengths and sizes");
  return v;
}

Tensor surface_motion(Tensor points, Tensor flow, std::vector<double> before, std::vector<double> after, bool arrived) {
  const Call call(points);
  const Tensor at = call.floats(points, "points"), cells = call.floats(flow, "flow");
  check(at.dim() == 2 && at.size(1) == 3, "points must be [N, 3]");
  check(cells.dim() == 3 && cells.size(2) == 2 && cells.numel() > 0, "flow must be [h, w, 2] with at least one cell");
  const View first = checked_view(before, "before"), second = checked_view(after, "after");
  const Flow f = {data(cells), cells.size(0), cells.size(1), second.height, second.width};
  Tensor motion = call.empty({at.size(0), 3});
  const auto kernel = arrived ? kernels().arrived : kernels().ahead;
  torch::stable::parallel_for(0, at.size(0), kGrain, [&](int64_t begin, int64_t end) {
    kernel(first, second, f, data(at), mutable_data(motion), begin, end);
  });
  return motion;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("surface_motion", GSPLAT_BOX(&surface_motion)); }

}  // namespace gsplat::surface_motion
