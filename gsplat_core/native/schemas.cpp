// Every op's schema, in one place. Autograd and fake kernels are attached in Python (gsplat_core/ops/*/).
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // The instruction set in use: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // Adam over one dense tensor, in place; `step` counts from 1.
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon) -> ()");
}
