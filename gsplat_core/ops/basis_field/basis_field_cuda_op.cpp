#include <cmath>
#include <tuple>

#include "basis_field_checks.h"
#include "basis_field_cuda.h"
#include "cuda_call.h"

namespace {

Tensor scalars(const CudaCall& call, const Tensor& t, int64_t count, const char* name) {
  check(t.numel() == count, name, " must hold ", count, " float32, got ", t.numel());
  return call.floats(t, name);
}

Tensor basis_field(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, bool padded) {
  check_shapes(centers, log_widths, weights);
  CudaCall call(centers);
  const Tensor c = call.floats(centers, "centers"), l = call.floats(log_widths, "log_widths"),
               w = call.floats(weights, "weights"), time = scalars(call, tau, 1, "tau");
  const int64_t row = padded ? kBasisPadded : kBasisChannels;
  Tensor deltas = call.empty({c.size(0), row});
  basis_field_on_device({data(c), data(l), data(w), data(time), c.size(0), c.size(1), int(row)}, mutable_data(deltas),
                        call.stream);
  check_cuda(cudaGetLastError(), "basis_field");
  return deltas;
}

std::tuple<Tensor, Tensor, Tensor> basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights,
                                                        Tensor tau) {
  check_shapes(centers, log_widths, weights);
  check_gradient(gradient, centers);
  CudaCall call(centers);
  const Tensor g = call.floats(gradient, "gradient"), c = call.floats(centers, "centers"),
               l = call.floats(log_widths, "log_widths"), w = call.floats(weights, "weights"),
               time = scalars(call, tau, 1, "tau");
  const int64_t n = c.size(0), bumps = c.size(1);
  Tensor v_centers = call.empty({n, bumps}), v_widths = call.empty({n, bumps}),
         v_weights = call.empty({n, bumps, kBasisChannels});
  basis_field_backward_on_device({data(c), data(l), data(w), data(time), n, bumps, int(g.size(1))}, data(g),
                                 mutable_data(v_centers), mutable_data(v_widths), mutable_data(v_weights), call.stream);
  check_cuda(cudaGetLastError(), "basis_field_backward");
  return {v_centers, v_widths, v_weights};
}

void basis_field_backward_adam_(Tensor gradient, Tensor tau, Tensor centers, Tensor log_widths, Tensor weights, Tensor m_centers,
                                Tensor m_log_widths, Tensor m_weights, Tensor v_centers, Tensor v_log_widths, Tensor v_weights,
                                Tensor steps, Tensor rates, double beta1, double beta2, double epsilon) {
  check_shapes(centers, log_widths, weights);
  check_shapes(m_centers, m_log_widths, m_weights);
  check_shapes(v_centers, v_log_widths, v_weights);
  check_gradient(gradient, centers);
  const std::initializer_list<const Tensor*> updated = {&centers,   &log_widths, &weights,      &m_centers, &m_log_widths,
                                                        &m_weights, &v_centers,  &v_log_widths, &v_weights};
  check_state(updated, steps);
  CudaCall call(centers);
  for (const Tensor* t : updated) call.floats(*t, "what basis_field_backward_adam_ updates");
  call.ints(steps, "steps");
  const Tensor g = call.floats(gradient, "gradient"), time = scalars(call, tau, 1, "tau"),
               learning_rates = scalars(call, rates, kBasisRates, "rates");
  DeviceBasisAdam field = {};
  field.centers = mutable_data(centers), field.log_widths = mutable_data(log_widths), field.weights = mutable_data(weights);
  field.m_centers = mutable_data(m_centers), field.m_log_widths = mutable_data(m_log_widths);
  field.m_weights = mutable_data(m_weights), field.v_centers = mutable_data(v_centers);
  field.v_log_widths = mutable_data(v_log_widths), field.v_weights = mutable_data(v_weights);
  field.steps = steps.mutable_data_ptr<int32_t>();
  field.tau = data(time), field.rates = data(learning_rates);
  field.count = centers.size(0), field.bumps = centers.size(1), field.row = int(g.size(1));
  field.fresh1 = float(1 - beta1), field.fresh2 = float(1 - beta2), field.epsilon = float(epsilon);
  field.log_beta1 = float(std::log(beta1)), field.log_beta2 = float(std::log(beta2));
  basis_field_adam_on_device(field, data(g), call.stream);
  check_cuda(cudaGetLastError(), "basis_field_backward_adam_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("basis_field", GSPLAT_BOX(&basis_field));
  m.impl("basis_field_backward", GSPLAT_BOX(&basis_field_backward));
  m.impl("basis_field_backward_adam_", GSPLAT_BOX(&basis_field_backward_adam_));
}
