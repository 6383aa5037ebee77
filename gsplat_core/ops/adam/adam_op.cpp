#include <cmath>

#include "adam.h"
#include "tensor_checks.h"

static int64_t active_isa_op() { return int64_t(active_isa()); }

static void adam_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, int64_t step,
                  double learning_rate, double beta1, double beta2, double epsilon) {
  const Tensor g = floats(gradient, "gradient");
  for (const Tensor* t : {&parameter, &first_moment, &second_moment})
    STD_TORCH_CHECK(t->is_contiguous() && t->numel() == g.numel(),
                    "adam_ updates contiguous tensors of the gradient's size in place");
  const float rate = float(learning_rate / (1 - std::pow(beta1, double(step))));
  const float inv_bias2 = float(1 / std::sqrt(1 - std::pow(beta2, double(step))));
  float *p = mutable_data(parameter), *m = mutable_data(first_moment), *v = mutable_data(second_moment);
  const float* gp = data(g);
  torch::stable::parallel_for(0, g.numel(), 1 << 14, [&](int64_t begin, int64_t end) {
    adam_kernels().step(p + begin, gp + begin, m + begin, v + begin, end - begin, rate, inv_bias2, float(beta1), float(beta2),
                        float(epsilon));
  });
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CompositeExplicitAutograd, m) { m.impl("active_isa", TORCH_BOX(&active_isa_op)); }
STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) { m.impl("adam_", TORCH_BOX(&adam_)); }
