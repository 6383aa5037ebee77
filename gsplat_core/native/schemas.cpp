// Every op's schema, in one place. Autograd and fake kernels are attached in Python (gsplat_core/ops/*/).
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // The instruction set in use: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // Adam over one dense tensor, in place; `step` counts from 1.
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon) -> ()");

  // Tiles: which splats each tile has, in depth order. `images` counts batch x cameras; image_ids is for packed splats.
  m.def(
      "isect_tiles(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int images, "
      "int tile_size, int tile_width, int tile_height, bool sort) -> (Tensor tiles_per_gauss, Tensor isect_ids, Tensor flatten_ids)");
  m.def(
      "bin_splats(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int images, "
      "int tile_size, int tile_width, int tile_height) -> (Tensor tiles_per_gauss, Tensor flatten_ids, Tensor isect_offsets)");
  m.def("isect_offset_encode(Tensor isect_ids, int images, int tile_width, int tile_height) -> Tensor");

  // Compositing: splats over pixels. `last` is the last blended position of flatten_ids per pixel, -1 where there is none.
  m.def(
      "composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor? backgrounds, Tensor? masks, int width, int height, int tile_size) -> (Tensor colors, Tensor alphas, Tensor last)");
  m.def(
      "composite_backward(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, "
      "Tensor flatten_ids, Tensor? backgrounds, Tensor? masks, int width, int height, int tile_size, Tensor alphas, Tensor last, "
      "Tensor v_colors, Tensor v_alphas, bool absgrad) -> (Tensor v_means2d, Tensor v_conics, Tensor v_colors, "
      "Tensor v_opacities, Tensor v_backgrounds, Tensor v_means2d_abs)");
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
}
