#include <cmath>

#include "adam_cuda.h"
#include "adam_options.h"
#include "cuda_call.h"

namespace {

Tensor adam_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, int64_t step, double learning_rate,
             double beta1, double beta2, double epsilon, int64_t row_size) {
  CudaCall call(parameter);
  const Tensor g = call.floats(gradient, "gradient");
  for (const Tensor* t : {&parameter, &first_moment, &second_moment}) {
    call.floats(*t, "what adam_ updates");
    check(t->is_contiguous() && t->numel() == g.numel(),
          "adam_ updates contiguous float32 tensors of the gradient's size in place");
  }
  check(row_size >= 1 && g.numel() % row_size == 0, "row_size must divide the number of values");
  const AdamStep options = adam_step_of(step, learning_rate, beta1, beta2, epsilon, row_size);
  Tensor skipped = call.empty({}, ScalarType::Long);
  int64_t* count = skipped.mutable_data_ptr<int64_t>();
  check_cuda(cudaMemsetAsync(count, 0, sizeof(int64_t), call.stream), "adam_");
  adam_on_device(mutable_data(parameter), data(g), mutable_data(first_moment), mutable_data(second_moment), g.numel() / row_size,
                 options, count, call.stream);
  check_cuda(cudaGetLastError(), "adam_");
  return skipped;
}

void adam_at_(Tensor parameter, Tensor gradient, Tensor first_moment, Tensor second_moment, Tensor rate, Tensor step,
              double beta1, double beta2, double epsilon, int64_t row_size, Tensor skipped) {
  CudaCall call(parameter);
  const Tensor g = call.floats(gradient, "gradient"), learning_rate = call.floats(rate, "rate"),
               steps = call.take(step, ScalarType::Long, "step");
  for (const Tensor* t : {&parameter, &first_moment, &second_moment}) {
    call.floats(*t, "what adam_at_ updates");
    check(t->is_contiguous() && t->numel() == g.numel(),
          "adam_at_ updates contiguous float32 tensors of the gradient's size in place");
  }
  check(row_size >= 1 && g.numel() % row_size == 0, "row_size must divide the number of values");
  call.take(skipped, ScalarType::Long, "skipped");
  check(rate.numel() == 1 && step.numel() == 1 && skipped.numel() == 1, "rate, step and skipped hold one number each");
  const AdamAt at = {data(learning_rate), steps.const_data_ptr<int64_t>(),
                     std::log(beta1),     std::log(beta2),
                     float(1 - beta1),    float(1 - beta2),
                     float(epsilon),      row_size};
  adam_at_on_device(mutable_data(parameter), data(g), mutable_data(first_moment), mutable_data(second_moment),
                    g.numel() / row_size, at, skipped.mutable_data_ptr<int64_t>(), call.stream);
  check_cuda(cudaGetLastError(), "adam_at_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("adam_", GSPLAT_BOX(&adam_));
  m.impl("adam_at_", GSPLAT_BOX(&adam_at_));
}
