// Every op's schema, in one place. Autograd and fake kernels are attached in Python (gsplat_core/ops/*/).
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // The instruction set in use: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // Adam over one dense tensor, in place; `step` counts from 1.
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon) -> ()");

  // Deformation by per-Gaussian basis functions in time: deltas [N, 13] at tau, its gradients, and gradients with lazy Adam.
  m.def("basis_field(Tensor centers, Tensor log_widths, Tensor weights, float tau) -> Tensor");
  m.def(
      "basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights, float tau) "
      "-> (Tensor, Tensor, Tensor)");
  m.def(
      "basis_field_backward_adam_(Tensor gradient, float tau, Tensor(a!) centers, Tensor(b!) log_widths, Tensor(c!) weights, "
      "Tensor(d!) m_centers, Tensor(e!) m_log_widths, Tensor(f!) m_weights, Tensor(g!) v_centers, Tensor(h!) v_log_widths, "
      "Tensor(i!) v_weights, Tensor(j!) steps, float position_rate, float rotation_rate, float scale_rate, float colour_rate, "
      "float center_rate, float width_rate, float beta1, float beta2, float epsilon) -> ()");

  // HexPlane features of one level: the product of six plane samples [N, C], its gradients, and the parts used for inference.
  m.def("hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def(
      "hexplane_features_backward(Tensor gradient, Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, "
      "Tensor zt) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) -> Tensor");
  m.def("hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def("hexplane_decode(Tensor[] spaces, Tensor coordinates, Tensor[] lines, Tensor[] weights, Tensor[] biases) -> Tensor");
}
