// Every op's schema, in one place. Autograd and fake kernels are attached in Python (gsplat_core/ops/*/).
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // The instruction set in use: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // Adam over one dense tensor, in place; `step` counts from 1. Rows of row_size values whose gradient is not finite are left
  // alone and counted in the result (int64 scalar).
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon, int row_size) -> Tensor");

  // Structural similarity of each pixel and channel of [H, W, C] images.
  m.def("ssim_map(Tensor image, Tensor target) -> Tensor");
  m.def("ssim_map_backward(Tensor gradient, Tensor image, Tensor target) -> Tensor");

  // Loss over tissue and its gradients in one go: (loss, [l1, 1 - ssim, inverse-depth l1], dL/dimage, dL/ddepth or empty).
  m.def(
      "image_loss(Tensor image, Tensor target, Tensor? mask, Tensor? depth, Tensor? target_depth, float ssim_weight, "
      "float depth_weight) -> (Tensor, Tensor, Tensor, Tensor)");
}
