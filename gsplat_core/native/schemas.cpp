// Every op's schema, in one place. Autograd and fake kernels are attached in Python (gsplat_core/ops/*/).
#include "torch_abi.h"

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // The instruction set in use: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // Adam over one dense tensor, in place; `step` counts from 1. Rows of row_size values whose gradient is not finite are left
  // alone and counted in the result (int64 scalar).
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon, int row_size) -> Tensor");

  // The same with learning rate (float32) and step (int64) read on the device; the rows left alone are added to `skipped`
  // (int64).
  m.def(
      "adam_at_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, Tensor rate, "
      "Tensor step, float beta1, float beta2, float epsilon, int row_size, Tensor(d!) skipped) -> ()");

  // Projection to the image: B batches, C cameras, N Gaussians. Covariances as [B, N, 6], or quats and scales.
  m.def(
      "project_gaussians(Tensor means, Tensor? covars, Tensor? quats, Tensor? scales, Tensor? opacities, Tensor viewmats, "
      "Tensor Ks, int width, int height, float eps2d, float near_plane, float far_plane, float radius_clip, bool compensate, "
      "int camera_model, float compensation_floor=0.005) -> (Tensor means2d, Tensor depths, Tensor conics, Tensor compensations, "
      "Tensor radii)");
  m.def(
      "project_gaussians_backward(Tensor means, Tensor? covars, Tensor? quats, Tensor? scales, Tensor viewmats, Tensor Ks, "
      "Tensor radii, Tensor? v_means2d, Tensor? v_depths, Tensor? v_conics, Tensor? v_compensations, int width, int height, "
      "float eps2d, int camera_model, bool needs_viewmats, float compensation_floor=0.005) -> (Tensor v_means, Tensor v_covars, "
      "Tensor v_quats, Tensor v_scales, Tensor v_viewmats)");

  // R rows of directions [R, M, 3] with coefficients [M, K, 3] that the rows share; where the mask is false the sum is 0.
  m.def("spherical_harmonics(int degree, Tensor dirs, Tensor coeffs, Tensor? masks) -> Tensor");
  m.def(
      "spherical_harmonics_backward(int degree, Tensor dirs, Tensor coeffs, Tensor? masks, Tensor v_colors, bool needs_dirs) "
      "-> (Tensor v_dirs, Tensor v_coeffs)");

  // Covariance and precision of M rotations and scales, as upper triangles [M, 6] or matrices [M, 3, 3]; empty if not asked.
  m.def(
      "quat_scale_to_covar_preci(Tensor quats, Tensor scales, bool compute_covar, bool compute_preci, bool triu) -> "
      "(Tensor covars, Tensor precis)");
  m.def(
      "quat_scale_to_covar_preci_backward(Tensor quats, Tensor scales, Tensor? v_covars, Tensor? v_precis, bool triu) -> "
      "(Tensor v_quats, Tensor v_scales)");

  // Tiles: which splats each tile has, in depth order. `images` counts batch x cameras; image_ids is for packed splats.
  m.def(
      "isect_tiles(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int "
      "images, "
      "int tile_size, int tile_width, int tile_height, bool sort) -> (Tensor tiles_per_gauss, Tensor isect_ids, Tensor "
      "flatten_ids)");
  m.def(
      "bin_splats(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int images, "
      "int tile_size, int tile_width, int tile_height) -> (Tensor tiles_per_gauss, Tensor flatten_ids, Tensor isect_offsets)");
  // The same in a list of `capacity` entries, without waiting for how many are needed: the unused ones, -1, are in front of the
  // first tile's, and splats that do not fit, the farthest ones, are in no list. `needed` is int64 [1].
  m.def(
      "bin_splats_within(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, "
      "int images, int tile_size, int tile_width, int tile_height, int capacity) -> (Tensor tiles_per_gauss, "
      "Tensor flatten_ids, Tensor isect_offsets, Tensor needed)");
  m.def("isect_offset_encode(Tensor isect_ids, int images, int tile_width, int tile_height) -> Tensor");

  // Compositing: splats over pixels. `last` is the last blended position of flatten_ids per pixel, -1 where there is none.
  // `absgrad_probe` is not read: its gradient is the sum over pixels of |dL/dmeans2d|.
  m.def(
      "composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor? backgrounds, Tensor? masks, Tensor? absgrad_probe, int width, int height, int tile_size, float max_alpha=0.99) -> "
      "(Tensor colors, Tensor alphas, Tensor last)");
  m.def(
      "composite_backward(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, "
      "Tensor flatten_ids, Tensor? backgrounds, Tensor? masks, int width, int height, int tile_size, Tensor alphas, Tensor last, "
      "Tensor v_colors, Tensor v_alphas, bool absgrad, float max_alpha=0.99) -> (Tensor v_means2d, Tensor v_conics, "
      "Tensor v_colors, Tensor v_opacities, Tensor v_backgrounds, Tensor v_means2d_abs)");

  // The whole of `rasterization()`, CUDA only: gsplat_core/ops/rasterization/rasterization.py names what is in the lists.
  m.def("rasterize(Tensor?[] inputs, int[] image_dims, int[] options, float[] ranges, bool training) -> Tensor[]");
  m.def(
      "rasterize_splats_backward(Tensor?[] saved, Tensor? v_image, Tensor? v_alphas, int[] image_dims, int[] options, "
      "float[] ranges) -> (Tensor v_records, Tensor v_means2d, Tensor v_absolute)");
  m.def(
      "rasterize_inputs_backward(Tensor?[] inputs, Tensor radii, Tensor? row_of, Tensor?[] gradients, int[] image_dims, "
      "int[] options, float[] ranges, bool[] needs) -> Tensor[]");

  // One frame from raw Gaussians (CUDA only): image [H, W, 4] with depth, and what its gradient needs. gaussians: means, quats,
  // log_scales, logit_opacities, sh. mode: 0 tile lists in one buffer, 1 the same for training, 2 a segment per tile.
  m.def(
      "render_frame(Tensor[] gaussians, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, int width, int height, "
      "float eps2d, float near_plane, float far_plane, int camera_model, int capacity, int mode) -> (Tensor image, "
      "Tensor alphas, Tensor last, Tensor records, Tensor tile_offsets, Tensor sorted, Tensor splat_starts, "
      "Tensor instance_splats, Tensor status)");
  // The gradient of render_frame: of the raw parameters as rows of raw_layout.h, and of sh if it has more than one basis.
  // forward: the results of render_frame in training mode, after the image.
  m.def(
      "render_frame_backward(Tensor[] gaussians, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, "
      "Tensor[] forward, Tensor v_image, Tensor? v_alphas, float eps2d, int camera_model, bool deterministic) -> "
      "(Tensor v_raw, Tensor v_sh)");
  // The same and one Adam step of the Gaussians, in place; rates [5] and step [1] are read on the device, rows that were left
  // unchanged are added to skipped [5]. v_raw is empty if not asked for. With residuals [H, W, 4] and relaxation [1] its colours
  // are what to add to them, and sh stays as it is.
  m.def(
      "render_frame_backward_adam_(Tensor(a!)[] gaussians, Tensor(b!)[] first_moments, Tensor(c!)[] second_moments, Tensor "
      "rates, "
      "Tensor step, Tensor(d!) skipped, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, Tensor[] forward, "
      "Tensor v_image, Tensor? v_alphas, Tensor? residuals, Tensor? relaxation, float eps2d, int camera_model, float beta1, "
      "float "
      "beta2, float epsilon, bool needs_raw, "
      "bool deterministic) -> Tensor v_raw");

  // Folds a frame's status [4] into `totals`: the maximum of every entry, but the number of frames that overflowed. Unless this
  // frame overflowed, step is incremented and fits [1] is 1, otherwise 0.
  m.def("accumulate_status_(Tensor status, Tensor(a!) totals, Tensor(b!) step) -> Tensor fits");

  // Deformation by per-Gaussian basis functions in time: deltas [N, 13] at tau, its gradients, and gradients with lazy Adam.
  // tau and the six rates (position, rotation, log-scale, colour, centres, widths) are float32 on the device of the field. Deltas
  // and gradients may be padded to the frame path's 16 columns.
  m.def("basis_field(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, bool padded=False) -> Tensor");
  m.def(
      "basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights, Tensor tau) "
      "-> (Tensor, Tensor, Tensor)");
  m.def(
      "basis_field_backward_adam_(Tensor gradient, Tensor tau, Tensor(a!) centers, Tensor(b!) log_widths, Tensor(c!) weights, "
      "Tensor(d!) m_centers, Tensor(e!) m_log_widths, Tensor(f!) m_weights, Tensor(g!) v_centers, Tensor(h!) v_log_widths, "
      "Tensor(i!) v_weights, Tensor(j!) steps, Tensor rates, float beta1, float beta2, float epsilon) -> ()");
  m.def("basis_field_add_colours_(Tensor centers, Tensor log_widths, Tensor(a!) weights, Tensor tau, Tensor change) -> ()");

  // Changes the weights as little as possible so that the deltas at tau are `target` [N, 13].
  m.def("basis_field_move_to_(Tensor centers, Tensor log_widths, Tensor(a!) weights, Tensor tau, Tensor target) -> ()");

  // How points [N, 3] move in the world as flow [h, w, 2] says, where they are in its first picture, or `arrived` in its second
  // one. A camera is 18 numbers: three rows of world-to-camera, fx, fy, cx, cy, width, height. CPU only.
  m.def("surface_motion(Tensor points, Tensor flow, float[] before, float[] after, bool arrived) -> Tensor");

  // Semi-global matching of two grey pictures uint8 [H, W] whose rows correspond, for the disparities lowest .. lowest + count -
  // 1: (sixteenths of a pixel int32 [H, W], the least int32 where unknown; uint8 [H, W], 1 where neither a jump nor a hole is
  // near).
  m.def("match_disparities(Tensor left, Tensor right, int lowest, int count) -> (Tensor, Tensor)");
  // Such disparities moved to where the pictures agree best around them: (pixels, their standard deviation) [H, W] each; 0 and
  // infinite where unknown.
  m.def("fit_disparities(Tensor left, Tensor right, Tensor sixteenths) -> (Tensor, Tensor)");

  // Planes [C, H, W] smoothed where a guide uint8 [H, W] or [H, W, channels] does not change by grey_step grey values or more.
  m.def("smooth_within_edges(Tensor planes, Tensor guide, float strength, float grey_step) -> Tensor");

  // Structural similarity of each pixel and channel of [H, W, C] images.
  m.def("ssim_map(Tensor image, Tensor target) -> Tensor");
  m.def("ssim_map_backward(Tensor gradient, Tensor image, Tensor target) -> Tensor");

  // Loss over tissue and its gradients in one go: (loss, [l1 or squared error, 1 - ssim, inverse-depth l1], dL/dimage, dL/ddepth
  // or empty).
  m.def(
      "image_loss(Tensor image, Tensor target, Tensor? mask, Tensor? depth, Tensor? target_depth, float ssim_weight, "
      "float depth_weight, bool squared=False) -> (Tensor, Tensor, Tensor, Tensor)");

  // The same of the frame path: image [H, W, 4] with colours and the sum of weight times z, alphas [H, W]; (loss, terms,
  // dL/dimage, dL/dalphas).
  m.def(
      "frame_loss(Tensor image, Tensor alphas, Tensor target, Tensor? mask, Tensor? target_depth, float ssim_weight, "
      "float depth_weight, bool squared=False) -> (Tensor, Tensor, Tensor, Tensor)");

  // Writes up to 64 values, which travel with the launch.
  m.def("store_scalars_(Tensor(a!) to, float[] values) -> ()");

  // HexPlane features of one level: the product of six plane samples [N, C], its gradients, and the parts used for inference.
  m.def("hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def(
      "hexplane_features_backward(Tensor gradient, Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, "
      "Tensor zt) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) -> Tensor");
  m.def("hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def("hexplane_decode(Tensor[] spaces, Tensor coordinates, Tensor[] lines, Tensor[] weights, Tensor[] biases) -> Tensor");
  // The field at `time`, from space features [N, C] of float32 or float16 (row i is Gaussian order[i]): deltas [N, 16]. CUDA
  // only.
  m.def(
      "hexplane_deltas(Tensor[] spaces, Tensor coordinates, Tensor? order, Tensor time, Tensor[] time_planes, Tensor[] weights, "
      "Tensor[] biases) -> Tensor");
  // Training of the whole field without autograd, CUDA only; ops/hexplane_training/hexplane_training.py describes what is passed
  // between them: state is what hexplane_train returns after the deltas, gradient what its backward pass returns after the
  // network's, and starts.
  m.def(
      "hexplane_train(Tensor means, Tensor box, Tensor time, Tensor[] planes, Tensor[] weights, Tensor[] biases) -> "
      "(Tensor deltas, Tensor coordinates, Tensor lines, Tensor features, Tensor hidden, Tensor order, Tensor starts)");
  m.def(
      "hexplane_train_backward(Tensor(a!) v_raw, Tensor box, Tensor[] state, Tensor[] planes, Tensor[] weights, "
      "Tensor[] biases) -> (Tensor network, Tensor rows, Tensor fractions, Tensor dense_sums, Tensor v_lines)");
  m.def("hexplane_planes_gradient(Tensor time, Tensor[] gradient, Tensor[] planes) -> Tensor[]");
  m.def(
      "hexplane_planes_adam_(Tensor(a!)[] planes, Tensor(b!)[] first, Tensor(c!)[] second, Tensor time, Tensor[] gradient, "
      "Tensor rate, Tensor step, Tensor? status, float beta1, float beta2, float epsilon, float smoothness, "
      "float time_smoothness, float sparsity) -> ()");
  m.def(
      "network_adam_(Tensor(a!)[] parameters, Tensor gradient, Tensor(b!) first, Tensor(c!) second, Tensor rate, Tensor step, "
      "Tensor? status, float beta1, float beta2, float epsilon) -> ()");
}
