#include <optional>
#include <tuple>

#include "covariance.h"
#include "cpu_call.h"

constexpr int64_t kGrain = 4096;

static void check_sizes(const Tensor& q, const Tensor& s) {
  check(q.dim() == 2 && s.dim() == 2 && q.size(1) == 4 && s.size(1) == 3 && q.size(0) == s.size(0),
        "covariance takes quats [M, 4] and scales [M, 3]");
}

static std::tuple<Tensor, Tensor> quat_scale_to_covar_preci(Tensor quats, Tensor scales, bool compute_covar, bool compute_preci,
                                                            bool triu) {
  const Tensor q = floats(quats, "quats"), s = floats(scales, "scales");
  check_sizes(q, s);
  const int64_t M = q.size(0);
  const auto make = [&](bool wanted, bool inverse) {
    if (!wanted) return empty_floats({0});
    Tensor t = triu ? empty_floats({M, 6}) : empty_floats({M, 3, 3});
    float* out = mutable_data(t);
    torch::stable::parallel_for(0, M, kGrain, [&](int64_t begin, int64_t end) {
      covariance_kernels().forward(data(q), data(s), out, inverse, triu, begin, end);
    });
    return t;
  };
  return {make(compute_covar, false), make(compute_preci, true)};
}

static std::tuple<Tensor, Tensor> quat_scale_to_covar_preci_backward(Tensor quats, Tensor scales,
                                                                     std::optional<Tensor> v_covars_in,
                                                                     std::optional<Tensor> v_precis_in, bool triu) {
  const Tensor q = floats(quats, "quats"), s = floats(scales, "scales");
  check_sizes(q, s);
  const int64_t M = q.size(0), columns = triu ? 6 : 9;
  std::optional<Tensor> v_covars, v_precis;
  if (v_covars_in.has_value()) v_covars = floats(*v_covars_in, "v_covars");
  if (v_precis_in.has_value()) v_precis = floats(*v_precis_in, "v_precis");
  check(
      (!v_covars.has_value() || v_covars->numel() == M * columns) && (!v_precis.has_value() || v_precis->numel() == M * columns),
      "covariance backward: the sizes of the gradients do not fit the inputs");
  Tensor v_quats = empty_floats({M, 4}), v_scales = empty_floats({M, 3});
  float *to_quats = mutable_data(v_quats), *to_scales = mutable_data(v_scales);
  const float *from_covars = v_covars.has_value() ? data(*v_covars) : nullptr,
              *from_precis = v_precis.has_value() ? data(*v_precis) : nullptr;
  torch::stable::parallel_for(0, M, kGrain, [&](int64_t begin, int64_t end) {
    covariance_kernels().backward(data(q), data(s), from_covars, from_precis, triu, to_quats, to_scales, begin, end);
  });
  return {v_quats, v_scales};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("quat_scale_to_covar_preci", GSPLAT_BOX(&quat_scale_to_covar_preci));
  m.impl("quat_scale_to_covar_preci_backward", GSPLAT_BOX(&quat_scale_to_covar_preci_backward));
}
