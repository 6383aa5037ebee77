#include <atomic>

#include "adam_options.h"
#include "cpu_call.h"

static int64_t active_isa_op() { return int64_t(active_isa()); }

static Tensor adam_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, int64_t step,
                    double learning_rate, double beta1, double beta2, double epsilon, int64_t row_size) {
  const Tensor g = floats(gradient, "gradient");
  for (const Tensor* t : {&parameter, &first_moment, &second_moment})
    check(t->is_cpu() && t->scalar_type() == ScalarType::Float && t->is_contiguous() && t->numel() == g.numel(),
          "adam_ updates contiguous float32 CPU tensors of the gradient's size in place");
  check(row_size >= 1 && g.numel() % row_size == 0, "row_size must divide the number of values");
  const AdamStep options = adam_step_of(step, learning_rate, beta1, beta2, epsilon, row_size);
  float *p = mutable_data(parameter), *m = mutable_data(first_moment), *v = mutable_data(second_moment);
  const float* gp = data(g);
  std::atomic<int64_t> skipped{0};
  const int64_t grain = 1 + (1 << 14) / row_size;
  torch::stable::parallel_for(0, g.numel() / row_size, grain, [&](int64_t begin, int64_t end) {
    const int64_t at = begin * row_size;
    skipped += adam_kernels().step(p + at, gp + at, m + at, v + at, end - begin, options);
  });
  Tensor result = torch::stable::empty({}, ScalarType::Long);
  *result.mutable_data_ptr<int64_t>() = skipped;
  return result;
}

static void adam_at_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, Tensor rate, Tensor step,
                     double beta1, double beta2, double epsilon, int64_t row_size, Tensor skipped) {
  const Tensor learning_rate = floats(rate, "rate");
  for (const Tensor* t : {&step, &skipped})
    check(t->is_cpu() && t->scalar_type() == ScalarType::Long && t->numel() == 1,
          "step and skipped must be one int64 each, on the CPU for this implementation");
  check(learning_rate.numel() == 1, "rate must be one float32");
  const Tensor count = adam_(parameter, gradient, first_moment, second_moment, *step.const_data_ptr<int64_t>(),
                             double(*data(learning_rate)), beta1, beta2, epsilon, row_size);
  *skipped.mutable_data_ptr<int64_t>() += *count.const_data_ptr<int64_t>();
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CompositeExplicitAutograd, m) { m.impl("active_isa", GSPLAT_BOX(&active_isa_op)); }
STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("adam_", GSPLAT_BOX(&adam_));
  m.impl("adam_at_", GSPLAT_BOX(&adam_at_));
}
