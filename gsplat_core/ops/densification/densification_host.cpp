#include "densification.h"
#include "host_call.h"

namespace gsplat::densification {
namespace {

#if defined(GSPLAT_CUDA)

void run(const Call& call, const Statistics& s) { accumulate_on_device(s, call.stream); }
void run(const Call& call, const Diffusion& d, int64_t count) { diffuse_on_device(d, count, call.stream); }

#else

constexpr int64_t kGrain = 4096;  // minimum Gaussians per task

void run(const Call&, const Statistics& s) {
  torch::stable::parallel_for(0, s.count, kGrain, [&](int64_t begin, int64_t end) { kernels().accumulate(s, begin, end); });
}
void run(const Call&, const Diffusion& d, int64_t count) {
  torch::stable::parallel_for(0, count, kGrain, [&](int64_t begin, int64_t end) { kernels().diffuse(d, begin, end); });
}

#endif

void accumulate_gradient_norms_(Tensor gradients, Tensor radii, double scale_x, double scale_y, double extent_scale, Tensor sums,
                                Tensor counts, OptionalTensor largest) {
  const Call call(gradients);
  const Tensor g = call.floats(gradients, "gradients"), r = call.take(radii, ScalarType::Int, "radii");
  check(g.dim() == 3 && g.size(2) == 2 && r.numel() == g.numel(),
        "accumulate_gradient_norms_ takes gradients and radii [C, N, 2]");
  const int64_t count = g.size(1);
  const auto statistic = [&](const Tensor& t, const char* name) {
    call.in_place(t, name);
    check(t.numel() == count, name, " must have ", count, " values, got ", t.numel());
    return mutable_data(t);
  };
  const Statistics s = {data(g),
                        r.const_data_ptr<int32_t>(),
                        float(scale_x),
                        float(scale_y),
                        float(extent_scale),
                        statistic(sums, "sums"),
                        statistic(counts, "counts"),
                        largest.has_value() ? statistic(*largest, "largest") : nullptr,
                        g.size(0),
                        count};
  run(call, s);
  call.finish("accumulate_gradient_norms_");
}

void diffuse_positions_(Tensor means, Tensor quats, Tensor log_scales, Tensor logits, Tensor noise, double scale,
                        double opacity_at_half, double steepness) {
  const Call call(means);
  call.in_place(means, "means");
  const Tensor q = call.floats(quats, "quats"), s = call.floats(log_scales, "log_scales"), o = call.floats(logits, "logits"),
               n = call.floats(noise, "noise");
  const int64_t count = o.numel();
  check(means.numel() == 3 * count && q.numel() == 4 * count && s.numel() == 3 * count && n.numel() == 3 * count,
        "diffuse_positions_ takes means, log_scales and noise [N, 3], quats [N, 4] and logits [N]");
  run(call, {mutable_data(means), data(q), data(s), data(o), data(n), float(scale), float(opacity_at_half), float(steepness)},
      count);
  call.finish("diffuse_positions_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("accumulate_gradient_norms_", GSPLAT_BOX(&accumulate_gradient_norms_));
  m.impl("diffuse_positions_", GSPLAT_BOX(&diffuse_positions_));
}

}  // namespace gsplat::densification
