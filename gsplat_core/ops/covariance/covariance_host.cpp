#include <tuple>

#include "covariance.h"
#include "host_call.h"

namespace gsplat::covariance {
namespace {

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Tensor& quats, const Tensor& scales, float* out, bool inverse, bool triu) {
  covariance_forward(data(quats), data(scales), out, inverse, triu, quats.size(0), call.stream);
}

void backward(const Call& call, const Tensor& quats, const Tensor& scales, const float* v_covars, const float* v_precis,
              bool triu, float* v_quats, float* v_scales) {
  covariance_backward(data(quats), data(scales), v_covars, v_precis, triu, v_quats, v_scales, quats.size(0), call.stream);
}

#else

constexpr int64_t kGrain = 4096;  // minimum rows per task

void forward(const Call&, const Tensor& quats, const Tensor& scales, float* out, bool inverse, bool triu) {
  torch::stable::parallel_for(0, quats.size(0), kGrain, [&](int64_t begin, int64_t end) {
    kernels().forward(data(quats), data(scales), out, inverse, triu, begin, end);
  });
}

void backward(const Call&, const Tensor& quats, const Tensor& scales, const float* v_covars, const float* v_precis, bool triu,
              float* v_quats, float* v_scales) {
  torch::stable::parallel_for(0, quats.size(0), kGrain, [&](int64_t begin, int64_t end) {
    kernels().backward(data(quats), data(scales), v_covars, v_precis, triu, v_quats, v_scales, begin, end);
  });
}

#endif

void check_sizes(const Tensor& quats, const Tensor& scales) {
  check(quats.dim() == 2 && scales.dim() == 2 && quats.size(1) == 4 && scales.size(1) == 3 && quats.size(0) == scales.size(0),
        "covariance takes quats [M, 4] and scales [M, 3]");
}

std::tuple<Tensor, Tensor> quat_scale_to_covar_preci(Tensor quats, Tensor scales, bool compute_covar, bool compute_preci,
                                                     bool triu) {
  const Call call(quats);
  const Tensor q = call.floats(quats, "quats"), s = call.floats(scales, "scales");
  check_sizes(q, s);
  const auto make = [&](bool wanted, bool inverse) {
    if (!wanted) return call.empty({0});
    Tensor t = triu ? call.empty({q.size(0), 6}) : call.empty({q.size(0), 3, 3});
    forward(call, q, s, mutable_data(t), inverse, triu);
    return t;
  };
  Tensor covars = make(compute_covar, false), precis = make(compute_preci, true);
  call.finish("quat_scale_to_covar_preci");
  return {covars, precis};
}

std::tuple<Tensor, Tensor> quat_scale_to_covar_preci_backward(Tensor quats, Tensor scales, OptionalTensor v_covars_,
                                                              OptionalTensor v_precis_, bool triu) {
  const Call call(quats);
  const Tensor q = call.floats(quats, "quats"), s = call.floats(scales, "scales");
  check_sizes(q, s);
  const OptionalTensor v_covars = call.floats(v_covars_, "v_covars"), v_precis = call.floats(v_precis_, "v_precis");
  const int64_t M = q.size(0), values = M * (triu ? 6 : 9);
  check((!v_covars.has_value() || v_covars->numel() == values) && (!v_precis.has_value() || v_precis->numel() == values),
        "covariance backward: a gradient must have ", values, " values for ", M, " matrices");
  Tensor v_quats = call.empty({M, 4}), v_scales = call.empty({M, 3});
  backward(call, q, s, data(v_covars), data(v_precis), triu, mutable_data(v_quats), mutable_data(v_scales));
  call.finish("quat_scale_to_covar_preci_backward");
  return {v_quats, v_scales};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("quat_scale_to_covar_preci", GSPLAT_BOX(&quat_scale_to_covar_preci));
  m.impl("quat_scale_to_covar_preci_backward", GSPLAT_BOX(&quat_scale_to_covar_preci_backward));
}

}  // namespace gsplat::covariance
