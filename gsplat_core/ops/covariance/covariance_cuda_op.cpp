#include <optional>
#include <tuple>

#include "covariance_cuda.h"
#include "cuda_call.h"

namespace {

void check_sizes(const Tensor& q, const Tensor& s) {
  check(q.dim() == 2 && s.dim() == 2 && q.size(1) == 4 && s.size(1) == 3 && q.size(0) == s.size(0),
        "covariance takes quats [M, 4] and scales [M, 3]");
}

std::tuple<Tensor, Tensor> quat_scale_to_covar_preci(Tensor quats, Tensor scales, bool compute_covar, bool compute_preci,
                                                     bool triu) {
  const CudaCall call(quats);
  const Tensor q = call.floats(quats, "quats"), s = call.floats(scales, "scales");
  check_sizes(q, s);
  const int64_t M = q.size(0);
  const auto make = [&](bool wanted, bool inverse) {
    if (!wanted) return call.empty({0});
    Tensor t = triu ? call.empty({M, 6}) : call.empty({M, 3, 3});
    covariance_forward(data(q), data(s), mutable_data(t), inverse, triu, M, call.stream);
    check_cuda(cudaGetLastError(), "quat_scale_to_covar_preci");
    return t;
  };
  return {make(compute_covar, false), make(compute_preci, true)};
}

std::tuple<Tensor, Tensor> quat_scale_to_covar_preci_backward(Tensor quats, Tensor scales, std::optional<Tensor> v_covars_in,
                                                              std::optional<Tensor> v_precis_in, bool triu) {
  const CudaCall call(quats);
  const Tensor q = call.floats(quats, "quats"), s = call.floats(scales, "scales");
  check_sizes(q, s);
  const int64_t M = q.size(0), columns = triu ? 6 : 9;
  std::optional<Tensor> v_covars, v_precis;
  if (v_covars_in.has_value()) v_covars = call.floats(*v_covars_in, "v_covars");
  if (v_precis_in.has_value()) v_precis = call.floats(*v_precis_in, "v_precis");
  check(
      (!v_covars.has_value() || v_covars->numel() == M * columns) && (!v_precis.has_value() || v_precis->numel() == M * columns),
      "covariance backward: the sizes of the gradients do not fit the inputs");
  Tensor v_quats = call.empty({M, 4}), v_scales = call.empty({M, 3});
  covariance_backward(data(q), data(s), v_covars.has_value() ? data(*v_covars) : nullptr,
                      v_precis.has_value() ? data(*v_precis) : nullptr, triu, mutable_data(v_quats), mutable_data(v_scales), M,
                      call.stream);
  check_cuda(cudaGetLastError(), "quat_scale_to_covar_preci_backward");
  return {v_quats, v_scales};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("quat_scale_to_covar_preci", GSPLAT_BOX(&quat_scale_to_covar_preci));
  m.impl("quat_scale_to_covar_preci_backward", GSPLAT_BOX(&quat_scale_to_covar_preci_backward));
}
