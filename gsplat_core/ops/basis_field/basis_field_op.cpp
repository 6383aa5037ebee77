#include <cmath>
#include <memory>
#include <mutex>
#include <tuple>
#include <vector>

#include "basis_field.h"
#include "basis_field_checks.h"
#include "cpu_call.h"

static constexpr int64_t kGrain = 1024;

static float value_of(const Tensor& tau) {
  const Tensor t = floats(tau, "tau");
  check(t.numel() == 1, "tau must be one float32");
  return data(t)[0];
}

static Tensor basis_field(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, bool padded) {
  check_shapes(centers, log_widths, weights);
  const Tensor c = floats(centers, "centers"), l = floats(log_widths, "log_widths"), w = floats(weights, "weights");
  const int64_t row = padded ? kBasisPadded : kBasisChannels;
  Tensor deltas = empty_floats({c.size(0), row});
  const BasisBumps field = {data(c), data(l), data(w), c.size(1), value_of(tau), row};
  float* out = mutable_data(deltas);
  torch::stable::parallel_for(0, c.size(0), kGrain,
                              [&](int64_t begin, int64_t end) { basis_field_kernels().forward(field, out, begin, end); });
  return deltas;
}

static std::tuple<Tensor, Tensor, Tensor> basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights,
                                                               Tensor tau) {
  check_shapes(centers, log_widths, weights);
  check_gradient(gradient, centers);
  const Tensor g = floats(gradient, "gradient"), c = floats(centers, "centers"), l = floats(log_widths, "log_widths"),
               w = floats(weights, "weights");
  const int64_t n = c.size(0), bumps = c.size(1);
  Tensor gc = empty_floats({n, bumps}), gl = empty_floats({n, bumps}), gw = empty_floats({n, bumps, kBasisChannels});
  const BasisBumps field = {data(c), data(l), data(w), bumps, value_of(tau), g.size(1)};
  const float* gp = data(g);
  float *gcp = mutable_data(gc), *glp = mutable_data(gl), *gwp = mutable_data(gw);
  torch::stable::parallel_for(
      0, n, kGrain, [&](int64_t begin, int64_t end) { basis_field_kernels().backward(field, gp, gcp, glp, gwp, begin, end); });
  return {gc, gl, gw};
}

// Adam's bias corrections by number of updates, up to where float32 no longer tells them from 1.
struct BiasTable {
  double beta1, beta2;
  std::vector<float> inverse_bias1, inverse_root_bias2;

  BiasTable(double b1, double b2) : beta1(b1), beta2(b2), inverse_bias1{1.0f}, inverse_root_bias2{1.0f} {
    constexpr size_t kLongest = size_t(1) << 16;
    double power1 = b1, power2 = b2;
    do {
      inverse_bias1.push_back(float(1 / (1 - power1)));
      inverse_root_bias2.push_back(float(1 / std::sqrt(1 - power2)));
      power1 *= b1;
      power2 *= b2;
    } while ((power1 > 1e-9 || power2 > 1e-9) && inverse_bias1.size() < kLongest);
  }
};

static std::shared_ptr<const BiasTable> bias_table(double beta1, double beta2) {
  static std::mutex mutex;
  static std::shared_ptr<const BiasTable> last;
  const std::lock_guard<std::mutex> lock(mutex);
  if (!last || last->beta1 != beta1 || last->beta2 != beta2) last = std::make_shared<const BiasTable>(beta1, beta2);
  return last;
}

static void basis_field_backward_adam_(Tensor gradient, Tensor tau, Tensor centers, Tensor log_widths, Tensor weights,
                                       Tensor m_centers, Tensor m_log_widths, Tensor m_weights, Tensor v_centers,
                                       Tensor v_log_widths, Tensor v_weights, Tensor steps, Tensor rates, double beta1,
                                       double beta2, double epsilon) {
  check_shapes(centers, log_widths, weights);
  check_shapes(m_centers, m_log_widths, m_weights);
  check_shapes(v_centers, v_log_widths, v_weights);
  check_gradient(gradient, centers);
  check_state({&centers, &log_widths, &weights, &m_centers, &m_log_widths, &m_weights, &v_centers, &v_log_widths, &v_weights},
              steps);
  check(centers.is_cpu() && steps.is_cpu(), "basis_field_backward_adam_ updates CPU tensors in this implementation");
  const Tensor g = floats(gradient, "gradient");
  const Tensor learning_rates = floats(rates, "rates");
  check(learning_rates.numel() == kBasisRates, "rates must be float32 [6]");
  const float* rate = data(learning_rates);
  const std::shared_ptr<const BiasTable> table = bias_table(beta1, beta2);
  BasisAdam field = {};
  field.centers = mutable_data(centers), field.log_widths = mutable_data(log_widths), field.weights = mutable_data(weights);
  field.m_centers = mutable_data(m_centers), field.m_log_widths = mutable_data(m_log_widths);
  field.m_weights = mutable_data(m_weights), field.v_centers = mutable_data(v_centers);
  field.v_log_widths = mutable_data(v_log_widths), field.v_weights = mutable_data(v_weights);
  field.steps = steps.mutable_data_ptr<int32_t>();
  field.bumps = centers.size(1), field.tau = value_of(tau), field.row = g.size(1);
  for (int channel = 0; channel < kBasisChannels; ++channel) field.channel_rates[channel] = rate[basis_rate_of(channel)];
  field.center_rate = rate[kBasisCenterRate], field.width_rate = rate[kBasisWidthRate];
  field.beta1 = float(beta1), field.beta2 = float(beta2), field.epsilon = float(epsilon);
  field.inverse_bias1 = table->inverse_bias1.data(), field.inverse_root_bias2 = table->inverse_root_bias2.data();
  field.table_size = int64_t(table->inverse_bias1.size());
  const float* gp = data(g);
  torch::stable::parallel_for(0, centers.size(0), kGrain,
                              [&](int64_t begin, int64_t end) { basis_field_kernels().adam(field, gp, begin, end); });
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("basis_field", GSPLAT_BOX(&basis_field));
  m.impl("basis_field_backward", GSPLAT_BOX(&basis_field_backward));
  m.impl("basis_field_backward_adam_", GSPLAT_BOX(&basis_field_backward_adam_));
}
