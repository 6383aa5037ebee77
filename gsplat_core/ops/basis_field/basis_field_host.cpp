#include "basis_field.h"

#include <cmath>
#include <memory>
#include <mutex>
#include <tuple>
#include <vector>

#include "host_call.h"

namespace gsplat::basis_field {
namespace {

void check_shapes(const Tensor& centers, const Tensor& log_widths, const Tensor& weights) {
  check(centers.dim() == 2 && log_widths.dim() == 2 && weights.dim() == 3 && weights.size(2) == kBasisChannels &&
            centers.size(0) == weights.size(0) && centers.size(1) == weights.size(1) && log_widths.size(0) == centers.size(0) &&
            log_widths.size(1) == centers.size(1),
        "basis_field takes centers [N, B], log_widths [N, B] and weights [N, B, 13]");
}

// Checked tensors of the field and the time.
struct Field {
  Tensor centers, log_widths, weights, tau;
  int64_t count, bumps;

  Field(const Call& call, const Tensor& centers_, const Tensor& log_widths_, const Tensor& weights_, const Tensor& tau_)
      : centers(call.floats(centers_, "centers")),
        log_widths(call.floats(log_widths_, "log_widths")),
        weights(call.floats(weights_, "weights")),
        tau(call.floats(tau_, "tau")) {
    check_shapes(centers, log_widths, weights);
    check(tau.numel() == 1, "tau must be one float32, got ", tau.numel());
    count = centers.size(0), bumps = centers.size(1);
  }
};

Tensor gradient_of(const Call& call, const Tensor& gradient, int64_t count) {
  check(gradient.dim() == 2 && gradient.size(0) == count &&
            (gradient.size(1) == kBasisChannels || gradient.size(1) == kBasisPadded),
        "the gradient must be [N, 13] or [N, 16] with N = ", count);
  return call.floats(gradient, "gradient");
}

// Tensors that Adam updates in place: three field parameters and their two moments.
struct State {
  float *centers, *log_widths, *weights;

  State(const Call& call, const Tensor& c, const Tensor& l, const Tensor& w, const Field& like) {
    check_shapes(c, l, w);
    check(c.size(0) == like.count && c.size(1) == like.bumps, "moments must have the field's ", like.count, " Gaussians and ",
          like.bumps, " bumps, got ", c.size(0), " and ", c.size(1));
    call.in_place(c, "centers or a moment of theirs");
    call.in_place(l, "log_widths or a moment of theirs");
    call.in_place(w, "weights or a moment of theirs");
    centers = mutable_data(c), log_widths = mutable_data(l), weights = mutable_data(w);
  }
};

struct Options {
  double beta1, beta2, epsilon;
};

template <class Adam>
Adam adam_of(const State& parameters, const State& first, const State& second, const Tensor& steps, const Field& f, int64_t row) {
  Adam a = {};
  a.centers = parameters.centers, a.log_widths = parameters.log_widths, a.weights = parameters.weights;
  a.m_centers = first.centers, a.m_log_widths = first.log_widths, a.m_weights = first.weights;
  a.v_centers = second.centers, a.v_log_widths = second.log_widths, a.v_weights = second.weights;
  a.steps = steps.mutable_data_ptr<int32_t>();
  a.bumps = f.bumps, a.row = decltype(a.row)(row);
  return a;
}

#if defined(GSPLAT_CUDA)

using Adam = DeviceBasisAdam;

DeviceBumps bumps_of(const Field& f, int64_t row) {
  return {data(f.centers), data(f.log_widths), data(f.weights), data(f.tau), f.count, f.bumps, int32_t(row)};
}

void forward(const Call& call, const Field& f, int64_t row, float* deltas) {
  basis_field_on_device(bumps_of(f, row), deltas, call.stream);
}

void backward(const Call& call, const Field& f, const Tensor& gradient, float* centers, float* log_widths, float* weights) {
  basis_field_backward_on_device(bumps_of(f, gradient.size(1)), data(gradient), centers, log_widths, weights, call.stream);
}

void update(const Call& call, Adam a, const Field& f, const Tensor& gradient, const float* rates, const Options& o) {
  a.tau = data(f.tau), a.rates = rates, a.count = f.count;
  a.fresh1 = float(1 - o.beta1), a.fresh2 = float(1 - o.beta2), a.epsilon = float(o.epsilon);
  a.log_beta1 = float(std::log(o.beta1)), a.log_beta2 = float(std::log(o.beta2));
  basis_field_adam_on_device(a, data(gradient), call.stream);
}

void add_colours(const Call& call, const Field& f, float* weights, const float* change) {
  basis_field_add_colours_on_device(bumps_of(f, kBasisChannels), weights, change, call.stream);
}

void move_to(const Call& call, const Field& f, float* weights, const float* target) {
  basis_field_move_to_on_device(bumps_of(f, kBasisChannels), weights, target, call.stream);
}

#else

using Adam = BasisAdam;
constexpr int64_t kGrain = 1024;  // minimum Gaussians per task

BasisBumps bumps_of(const Field& f, int64_t row) {
  return {data(f.centers), data(f.log_widths), data(f.weights), f.bumps, data(f.tau)[0], row};
}

void forward(const Call&, const Field& f, int64_t row, float* deltas) {
  const BasisBumps field = bumps_of(f, row);
  torch::stable::parallel_for(0, f.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().forward(field, deltas, begin, end); });
}

void backward(const Call&, const Field& f, const Tensor& gradient, float* centers, float* log_widths, float* weights) {
  const BasisBumps field = bumps_of(f, gradient.size(1));
  torch::stable::parallel_for(0, f.count, kGrain, [&](int64_t begin, int64_t end) {
    kernels().backward(field, data(gradient), centers, log_widths, weights, begin, end);
  });
}

// Adam's bias corrections by number of updates, up to the update at which they equal 1 in float32.
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

std::shared_ptr<const BiasTable> bias_table(double beta1, double beta2) {
  static std::mutex mutex;
  static std::shared_ptr<const BiasTable> last;
  const std::lock_guard<std::mutex> lock(mutex);
  if (!last || last->beta1 != beta1 || last->beta2 != beta2) last = std::make_shared<const BiasTable>(beta1, beta2);
  return last;
}

void update(const Call&, Adam a, const Field& f, const Tensor& gradient, const float* rates, const Options& o) {
  const std::shared_ptr<const BiasTable> table = bias_table(o.beta1, o.beta2);
  a.tau = data(f.tau)[0];
  for (int channel = 0; channel < kBasisChannels; ++channel) a.channel_rates[channel] = rates[basis_rate_of(channel)];
  a.center_rate = rates[kBasisCenterRate], a.width_rate = rates[kBasisWidthRate];
  a.beta1 = float(o.beta1), a.beta2 = float(o.beta2), a.epsilon = float(o.epsilon);
  a.inverse_bias1 = table->inverse_bias1.data(), a.inverse_root_bias2 = table->inverse_root_bias2.data();
  a.table_size = int64_t(table->inverse_bias1.size());
  torch::stable::parallel_for(0, f.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().adam(a, data(gradient), begin, end); });
}

void add_colours(const Call&, const Field& f, float* weights, const float* change) {
  const BasisBumps field = bumps_of(f, kBasisChannels);
  torch::stable::parallel_for(0, f.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().add_colours(field, weights, change, begin, end); });
}

void move_to(const Call&, const Field& f, float* weights, const float* target) {
  const BasisBumps field = bumps_of(f, kBasisChannels);
  torch::stable::parallel_for(0, f.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().move_to(field, weights, target, begin, end); });
}

#endif

Tensor basis_field(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, bool padded) {
  const Call call(centers);
  const Field field(call, centers, log_widths, weights, tau);
  const int64_t row = padded ? kBasisPadded : kBasisChannels;
  Tensor deltas = call.empty({field.count, row});
  forward(call, field, row, mutable_data(deltas));
  call.finish("basis_field");
  return deltas;
}

std::tuple<Tensor, Tensor, Tensor> basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights,
                                                        Tensor tau) {
  const Call call(centers);
  const Field field(call, centers, log_widths, weights, tau);
  const Tensor g = gradient_of(call, gradient, field.count);
  Tensor v_centers = call.empty({field.count, field.bumps}), v_widths = call.empty({field.count, field.bumps}),
         v_weights = call.empty({field.count, field.bumps, kBasisChannels});
  backward(call, field, g, mutable_data(v_centers), mutable_data(v_widths), mutable_data(v_weights));
  call.finish("basis_field_backward");
  return {v_centers, v_widths, v_weights};
}

void basis_field_backward_adam_(Tensor gradient, Tensor tau, Tensor centers, Tensor log_widths, Tensor weights, Tensor m_centers,
                                Tensor m_log_widths, Tensor m_weights, Tensor v_centers, Tensor v_log_widths, Tensor v_weights,
                                Tensor steps, Tensor rates, double beta1, double beta2, double epsilon) {
  const Call call(centers);
  const Field field(call, centers, log_widths, weights, tau);
  const State parameters(call, centers, log_widths, weights, field), first(call, m_centers, m_log_widths, m_weights, field),
      second(call, v_centers, v_log_widths, v_weights, field);
  call.in_place(steps, ScalarType::Int, "steps");
  check(steps.numel() == field.count * field.bumps, "steps must be int32 [N, B], got ", steps.numel(), " values");
  const Tensor g = gradient_of(call, gradient, field.count), learning_rates = call.floats(rates, "rates");
  check(learning_rates.numel() == kBasisRates, "rates must be float32 [", kBasisRates, "], got ", learning_rates.numel());
  update(call, adam_of<Adam>(parameters, first, second, steps, field, g.size(1)), field, g, data(learning_rates),
         {beta1, beta2, epsilon});
  call.finish("basis_field_backward_adam_");
}

void basis_field_add_colours_(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, Tensor change) {
  const Call call(centers);
  const Field field(call, centers, log_widths, weights, tau);
  call.in_place(weights, "weights");
  const Tensor colours = call.floats(change, "change");
  check(colours.dim() == 2 && colours.size(0) == field.count && colours.size(1) == 3,
        "change must be [N, 3] with N = ", field.count);
  add_colours(call, field, mutable_data(weights), data(colours));
  call.finish("basis_field_add_colours_");
}

void basis_field_move_to_(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, Tensor target) {
  const Call call(centers);
  const Field field(call, centers, log_widths, weights, tau);
  call.in_place(weights, "weights");
  const Tensor wanted = call.floats(target, "target");
  check(wanted.dim() == 2 && wanted.size(0) == field.count && wanted.size(1) == kBasisChannels, "the target must be [N, ",
        kBasisChannels, "] with N = ", field.count);
  move_to(call, field, mutable_data(weights), data(wanted));
  call.finish("basis_field_move_to_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("basis_field", GSPLAT_BOX(&basis_field));
  m.impl("basis_field_backward", GSPLAT_BOX(&basis_field_backward));
  m.impl("basis_field_backward_adam_", GSPLAT_BOX(&basis_field_backward_adam_));
  m.impl("basis_field_add_colours_", GSPLAT_BOX(&basis_field_add_colours_));
  m.impl("basis_field_move_to_", GSPLAT_BOX(&basis_field_move_to_));
}

}  // namespace gsplat::basis_field
