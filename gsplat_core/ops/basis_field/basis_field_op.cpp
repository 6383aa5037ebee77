#include <cmath>
#include <memory>
#include <mutex>
#include <tuple>
#include <vector>

#include "basis_field.h"
#include "tensor_checks.h"

static constexpr int64_t kGrain = 1024;

static void check_shapes(const Tensor& centers, const Tensor& log_widths, const Tensor& weights) {
  STD_TORCH_CHECK(centers.dim() == 2 && log_widths.dim() == 2 && weights.dim() == 3 && weights.size(2) == kBasisChannels &&
                      centers.size(0) == weights.size(0) && centers.size(1) == weights.size(1) &&
                      log_widths.size(0) == centers.size(0) && log_widths.size(1) == centers.size(1),
                  "basis_field takes centers [N, B], log_widths [N, B] and weights [N, B, 13]");
}

static void check_gradient(const Tensor& gradient, const Tensor& centers) {
  STD_TORCH_CHECK(gradient.dim() == 2 && gradient.size(0) == centers.size(0) && gradient.size(1) == kBasisChannels,
                  "the gradient must be [N, 13] with N = ", centers.size(0));
}

static Tensor basis_field(Tensor centers, Tensor log_widths, Tensor weights, double tau) {
  check_shapes(centers, log_widths, weights);
  const Tensor c = floats(centers, "centers"), l = floats(log_widths, "log_widths"), w = floats(weights, "weights");
  Tensor deltas = empty_floats({c.size(0), kBasisChannels});
  const BasisBumps field = {data(c), data(l), data(w), c.size(1), float(tau)};
  float* out = mutable_data(deltas);
  torch::stable::parallel_for(0, c.size(0), kGrain,
                              [&](int64_t begin, int64_t end) { basis_field_kernels().forward(field, out, begin, end); });
  return deltas;
}

static std::tuple<Tensor, Tensor, Tensor> basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights,
                                                               double tau) {
  check_shapes(centers, log_widths, weights);
  check_gradient(gradient, centers);
  const Tensor g = floats(gradient, "gradient"), c = floats(centers, "centers"), l = floats(log_widths, "log_widths"),
               w = floats(weights, "weights");
  const int64_t n = c.size(0), bumps = c.size(1);
  Tensor gc = empty_floats({n, bumps}), gl = empty_floats({n, bumps}), gw = empty_floats({n, bumps, kBasisChannels});
  const BasisBumps field = {data(c), data(l), data(w), bumps, float(tau)};
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

static void basis_field_backward_adam_(Tensor gradient, double tau, Tensor centers, Tensor log_widths, Tensor weights,
                                       Tensor m_centers, Tensor m_log_widths, Tensor m_weights, Tensor v_centers,
                                       Tensor v_log_widths, Tensor v_weights, Tensor steps, double position_rate,
                                       double rotation_rate, double scale_rate, double colour_rate, double center_rate,
                                       double width_rate, double beta1, double beta2, double epsilon) {
  check_shapes(centers, log_widths, weights);
  check_shapes(m_centers, m_log_widths, m_weights);
  check_shapes(v_centers, v_log_widths, v_weights);
  check_gradient(gradient, centers);
  for (const Tensor* t :
       {&centers, &log_widths, &weights, &m_centers, &m_log_widths, &m_weights, &v_centers, &v_log_widths, &v_weights})
    STD_TORCH_CHECK(t->is_cpu() && t->is_contiguous() && t->scalar_type() == ScalarType::Float,
                    "basis_field_backward_adam_ updates contiguous float32 CPU tensors in place");
  for (const Tensor* t : {&m_centers, &v_centers, &steps})
    STD_TORCH_CHECK(t->numel() == centers.numel(), "moments and steps must have the field's number of Gaussians and bumps");
  STD_TORCH_CHECK(steps.is_cpu() && steps.is_contiguous() && steps.scalar_type() == ScalarType::Int,
                  "steps must be a contiguous int32 CPU tensor");
  const Tensor g = floats(gradient, "gradient");
  const std::shared_ptr<const BiasTable> table = bias_table(beta1, beta2);
  BasisAdam field = {};
  field.centers = mutable_data(centers), field.log_widths = mutable_data(log_widths), field.weights = mutable_data(weights);
  field.m_centers = mutable_data(m_centers), field.m_log_widths = mutable_data(m_log_widths);
  field.m_weights = mutable_data(m_weights), field.v_centers = mutable_data(v_centers);
  field.v_log_widths = mutable_data(v_log_widths), field.v_weights = mutable_data(v_weights);
  field.steps = steps.mutable_data_ptr<int32_t>();
  field.bumps = centers.size(1), field.tau = float(tau);
  const double groups[4] = {position_rate, rotation_rate, scale_rate, colour_rate};
  const int sizes[4] = {3, 4, 3, 3};
  for (int group = 0, channel = 0; group < 4; ++group)
    for (int i = 0; i < sizes[group]; ++i) field.channel_rates[channel++] = float(groups[group]);
  field.center_rate = float(center_rate), field.width_rate = float(width_rate);
  field.beta1 = float(beta1), field.beta2 = float(beta2), field.epsilon = float(epsilon);
  field.inverse_bias1 = table->inverse_bias1.data(), field.inverse_root_bias2 = table->inverse_root_bias2.data();
  field.table_size = int64_t(table->inverse_bias1.size());
  const float* gp = data(g);
  torch::stable::parallel_for(0, centers.size(0), kGrain,
                              [&](int64_t begin, int64_t end) { basis_field_kernels().adam(field, gp, begin, end); });
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("basis_field", TORCH_BOX(&basis_field));
  m.impl("basis_field_backward", TORCH_BOX(&basis_field_backward));
  m.impl("basis_field_backward_adam_", TORCH_BOX(&basis_field_backward_adam_));
}
