#include <atomic>
#include <cmath>

#include "adam.h"
#include "host_call.h"

namespace gsplat::adam {
namespace {

struct Options {
  double beta1, beta2, epsilon;
  int64_t row_size;
};

// Checked parameter, gradient and moments of one call.
struct Rows {
  Tensor gradient;
  OptionalTensor shown_rows;
  float *p, *m, *v;
  const bool* shown;  // [count], false for rows that are left unchanged; null: all rows are updated
  int64_t count;

  Rows(const Call& call, const Tensor& parameter, const Tensor& gradient_, const Tensor& first_moment,
       const Tensor& second_moment, int64_t row_size, const OptionalTensor& shown_ = std::nullopt)
      : gradient(call.floats(gradient_, "gradient")), shown_rows(call.take_optional(shown_, ScalarType::Bool, "shown")) {
    const int64_t values = gradient.numel();
    const auto updated = [&](const Tensor& t, const char* name) {
      call.in_place(t, name);
      check(t.numel() == values, name, " must have the gradient's ", values, " values, got ", t.numel());
      return mutable_data(t);
    };
    p = updated(parameter, "parameter"), m = updated(first_moment, "first_moment"), v = updated(second_moment, "second_moment");
    check(row_size >= 1 && values % row_size == 0, "row_size must divide the ", values, " values, got ", row_size);
    count = values / row_size;
    shown = shown_rows.has_value() ? shown_rows->const_data_ptr<bool>() : nullptr;
    check(shown == nullptr || shown_rows->numel() == count, "shown must have one value for each of the ", count, " rows, got ",
          shown != nullptr ? shown_rows->numel() : 0);
  }
};

// Compute the factors of the update in double.
AdamStep step_of(int64_t step, double learning_rate, const Options& o) {
  return {float(learning_rate / (1 - std::pow(o.beta1, double(step)))),
          float(1 / std::sqrt(1 - std::pow(o.beta2, double(step)))),
          float(1 - o.beta1),
          float(1 - o.beta2),
          float(o.epsilon),
          o.row_size};
}

// Step with the factors from the host, and step with learning rate and step number in device memory. Both add the
// number of skipped rows to `skipped` in device memory.
#if defined(GSPLAT_CUDA)

void update(const Call& call, const Rows& rows, const AdamStep& step, int64_t* skipped) {
  adam_on_device(rows.p, data(rows.gradient), rows.m, rows.v, rows.shown, rows.count, step, skipped, call.stream);
}

void update_at(const Call& call, const Rows& rows, const float* rate, const int64_t* step, const Options& o, int64_t* skipped) {
  const AdamAt at = {
      rate, step, std::log(o.beta1), std::log(o.beta2), float(1 - o.beta1), float(1 - o.beta2), float(o.epsilon), o.row_size};
  adam_at_on_device(rows.p, data(rows.gradient), rows.m, rows.v, rows.count, at, skipped, call.stream);
}

#else

void update(const Call&, const Rows& rows, const AdamStep& step, int64_t* skipped) {
  std::atomic<int64_t> left_alone{0};
  const int64_t grain = 1 + (1 << 14) / step.row_size;
  torch::stable::parallel_for(0, rows.count, grain, [&](int64_t begin, int64_t end) {
    const int64_t at = begin * step.row_size;
    left_alone += kernels().step(rows.p + at, data(rows.gradient) + at, rows.m + at, rows.v + at,
                                 rows.shown != nullptr ? rows.shown + begin : nullptr, end - begin, step);
  });
  *skipped += left_alone;
}

void update_at(const Call& call, const Rows& rows, const float* rate, const int64_t* step, const Options& o, int64_t* skipped) {
  update(call, rows, step_of(*step, double(*rate), o), skipped);
}

#endif

Tensor adam_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, int64_t step, double learning_rate,
             double beta1, double beta2, double epsilon, int64_t row_size, OptionalTensor shown) {
  const Call call(parameter);
  const Rows rows(call, parameter, gradient, first_moment, second_moment, row_size, shown);
  Tensor skipped = call.zeros({}, ScalarType::Long);
  update(call, rows, step_of(step, learning_rate, {beta1, beta2, epsilon, row_size}), skipped.mutable_data_ptr<int64_t>());
  call.finish("adam_");
  return skipped;
}

void adam_at_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, Tensor rate, Tensor step,
              double beta1, double beta2, double epsilon, int64_t row_size, Tensor skipped) {
  const Call call(parameter);
  const Rows rows(call, parameter, gradient, first_moment, second_moment, row_size);
  const Tensor learning_rate = call.floats(rate, "rate"), steps = call.take(step, ScalarType::Long, "step");
  call.in_place(skipped, ScalarType::Long, "skipped");
  check(rate.numel() == 1 && step.numel() == 1 && skipped.numel() == 1, "rate, step and skipped hold one number each, got ",
        rate.numel(), ", ", step.numel(), " and ", skipped.numel());
  update_at(call, rows, data(learning_rate), steps.const_data_ptr<int64_t>(), {beta1, beta2, epsilon, row_size},
            skipped.mutable_data_ptr<int64_t>());
  call.finish("adam_at_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("adam_", GSPLAT_BOX(&adam_));
  m.impl("adam_at_", GSPLAT_BOX(&adam_at_));
}

}  // namespace gsplat::adam
