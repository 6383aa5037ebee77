// Schemas of all ops. Autograd and fake kernels are registered in Python (gsplat_core/ops/*/).
#include "torch_abi.h"

STABLE_TORCH_LIBRARY(gsplat_core, m) {
  // Selected instruction set: 0 baseline, 1 AVX2, 2 AVX-512.
  m.def("active_isa() -> int");

  // In-place Adam step of one dense tensor; `step` counts from 1. Rows of row_size values with a non-finite gradient
  // are skipped. Returns the number of skipped rows (int64 scalar). Rows that are false in `shown` (bool) are left unchanged
  // and not counted.
  m.def(
      "adam_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, int step, "
      "float learning_rate, float beta1, float beta2, float epsilon, int row_size, Tensor? shown=None) -> Tensor");

  // In-place Adam step of one dense tensor, with the learning rate (float32) and step (int64) read from device memory.
  // The number of skipped rows is added to `skipped` (int64).
  m.def(
      "adam_at_(Tensor(a!) parameter, Tensor gradient, Tensor(b!) first_moment, Tensor(c!) second_moment, Tensor rate, "
      "Tensor step, float beta1, float beta2, float epsilon, int row_size, Tensor(d!) skipped) -> ()");

  // In place: lengths of the screen gradients [C, N, 2] of one step, added to statistics [N] of the visible Gaussians.
  m.def(
      "accumulate_gradient_norms_(Tensor gradients, Tensor radii, float scale_x, float scale_y, float extent_scale, "
      "Tensor(a!) sums, Tensor(b!) counts, Tensor(c!)? largest) -> ()");

  // In place: covariance times noise, added to positions, less for visible Gaussians.
  m.def(
      "diffuse_positions_(Tensor(a!) means, Tensor quats, Tensor log_scales, Tensor logits, Tensor noise, float scale, "
      "float opacity_at_half, float steepness) -> ()");

  // Projection of N Gaussians in B batches to C cameras. The covariance is given as [B, N, 6] or as quats and scales.
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

  // Unscented-transform projection. A row of `cameras` [B, C, 35] holds lens, fold-over limit, pose and motion.
  m.def(
      "project_unscented(Tensor means, Tensor quats, Tensor scales, Tensor? opacities, Tensor cameras, int model, int shutter, "
      "bool distorted, int width, int height, float eps2d, float near_plane, float far_plane, float radius_clip, "
      "bool compensate, float compensation_floor, float spread, float weight, float center_weight, float margin, "
      "bool all_inside) -> (Tensor means2d, Tensor depths, Tensor conics, Tensor compensations, Tensor radii)");
  m.def(
      "project_unscented_backward(Tensor means, Tensor quats, Tensor scales, Tensor cameras, Tensor radii, Tensor? v_means2d, "
      "Tensor? v_depths, Tensor? v_conics, Tensor? v_compensations, int model, int shutter, bool distorted, int width, "
      "int height, float eps2d, float compensation_floor, float spread, float weight, float center_weight) -> (Tensor v_means, "
      "Tensor v_quats, Tensor v_scales)");

  // Blending by the response of Gaussians [B, N, 12] (mean, whitening matrix) along rays [I, H, W, 6]. `last` has the position
  // in flatten_ids of each pixel's last blended Gaussian, or -1. The gradients of Gaussians have a row per image: [I, N, 12].
  m.def(
      "blend_world(Tensor gaussians, Tensor colors, Tensor opacities, Tensor rays, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor? masks, int tile_size, float max_alpha) -> (Tensor colors, Tensor through, Tensor last)");
  m.def(
      "blend_world_backward(Tensor gaussians, Tensor colors, Tensor opacities, Tensor rays, Tensor isect_offsets, Tensor "
      "flatten_ids, Tensor? masks, int tile_size, float max_alpha, Tensor through, Tensor last, Tensor v_colors, Tensor "
      "v_through) -> (Tensor v_gaussians, Tensor v_colors, Tensor v_opacities, Tensor v_rays)");

  // Projection of visible pairs of camera and Gaussian only, in ascending order of their ids: (batch * cameras +
  // camera) * gaussians + gaussian (int64 [rows]). The gradients have one row per pair. The host waits for the number
  // of pairs.
  m.def(
      "project_visible(Tensor means, Tensor? covars, Tensor? quats, Tensor? scales, Tensor? opacities, Tensor viewmats, "
      "Tensor Ks, int width, int height, float eps2d, float near_plane, float far_plane, float radius_clip, bool compensate, "
      "int camera_model, float compensation_floor) -> (Tensor ids, Tensor means2d, Tensor depths, Tensor conics, Tensor "
      "compensations, Tensor radii)");
  m.def(
      "project_visible_backward(Tensor means, Tensor? covars, Tensor? quats, Tensor? scales, Tensor viewmats, Tensor Ks, "
      "Tensor ids, Tensor? v_means2d, Tensor? v_depths, Tensor? v_conics, Tensor? v_compensations, int width, int height, "
      "float eps2d, int camera_model, bool needs_viewmats, float compensation_floor) -> (Tensor v_means, Tensor v_covars, "
      "Tensor v_quats, Tensor v_scales, Tensor v_viewmats)");
  // Add values [rows, D] of visible pairs of camera and Gaussian to their Gaussians [B, N, D], camera by camera.
  m.def("add_packed_rows_(Tensor(a!) out, Tensor values, Tensor ids, int cameras) -> ()");

  // Colours of R rows of directions [R, M, 3]; all rows share the coefficients [M, K, 3]. The result is 0 where the
  // mask is false.
  m.def("spherical_harmonics(int degree, Tensor dirs, Tensor coeffs, Tensor? masks) -> Tensor");
  m.def(
      "spherical_harmonics_backward(int degree, Tensor dirs, Tensor coeffs, Tensor? masks, Tensor v_colors, bool needs_dirs) "
      "-> (Tensor v_dirs, Tensor v_coeffs)");

  // Covariance and precision of M rotations and scales, as upper triangles [M, 6] or matrices [M, 3, 3]. Outputs that
  // are not requested are empty.
  m.def(
      "quat_scale_to_covar_preci(Tensor quats, Tensor scales, bool compute_covar, bool compute_preci, bool triu) -> "
      "(Tensor covars, Tensor precis)");
  m.def(
      "quat_scale_to_covar_preci_backward(Tensor quats, Tensor scales, Tensor? v_covars, Tensor? v_precis, bool triu) -> "
      "(Tensor v_quats, Tensor v_scales)");

  // Tile intersection: the splats of each tile, in depth order. `images` is batches x cameras; image_ids is given for
  // packed splats.
  m.def(
      "isect_tiles(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int "
      "images, "
      "int tile_size, int tile_width, int tile_height, bool sort) -> (Tensor tiles_per_gauss, Tensor isect_ids, Tensor "
      "flatten_ids)");
  m.def(
      "bin_splats(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, int images, "
      "int tile_size, int tile_width, int tile_height) -> (Tensor tiles_per_gauss, Tensor flatten_ids, Tensor isect_offsets)");
  // Tile intersection with a fixed list length `capacity`, so that the host does not wait for the required length.
  // Unused entries are -1 and precede the first tile's list. If the list overflows, the farthest splats are dropped.
  // `needed` (int64 [1]) is the required length.
  m.def(
      "bin_splats_within(Tensor means2d, Tensor radii, Tensor depths, Tensor? conics, Tensor? opacities, Tensor? image_ids, "
      "int images, int tile_size, int tile_width, int tile_height, int capacity) -> (Tensor tiles_per_gauss, "
      "Tensor flatten_ids, Tensor isect_offsets, Tensor needed)");
  m.def("isect_offset_encode(Tensor isect_ids, int images, int tile_width, int tile_height) -> Tensor");

  // Alpha compositing of splats. `last` is the position in flatten_ids of each pixel's last blended splat, or -1.
  // `absgrad_probe` is an unread input; its gradient is the sum over pixels of |dL/dmeans2d|.
  m.def(
      "composite(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor? backgrounds, Tensor? masks, Tensor? absgrad_probe, int width, int height, int tile_size, float max_alpha=0.99) -> "
      "(Tensor colors, Tensor alphas, Tensor last)");
  m.def(
      "composite_backward(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, "
      "Tensor flatten_ids, Tensor? backgrounds, Tensor? masks, int width, int height, int tile_size, Tensor alphas, Tensor last, "
      "Tensor v_colors, Tensor v_alphas, bool absgrad, float max_alpha=0.99) -> (Tensor v_means2d, Tensor v_conics, "
      "Tensor v_colors, Tensor v_opacities, Tensor v_backgrounds, Tensor v_means2d_abs)");
  // Colours [N, 3] of one picture's splats after `steps` corrections by its residual, for the CPU (correct_colours.h).
  m.def(
      "correct_colours(Tensor means2d, Tensor conics, Tensor colors, Tensor opacities, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor image, Tensor mask, int steps, float relaxation, float least_weight, float max_alpha=0.99) -> Tensor");

  // Coefficients [N, 10] of the depth along the rays of a pinhole camera (ray_blending.h), and the shortest axes [N, 3] in
  // camera axes, towards the camera.
  m.def("splat_rays(Tensor means, Tensor quats, Tensor scales, Tensor viewmat, Tensor K) -> (Tensor rays, Tensor normals)");
  m.def(
      "splat_rays_backward(Tensor means, Tensor quats, Tensor scales, Tensor viewmat, Tensor K, Tensor v_rays, Tensor v_normals) "
      "-> (Tensor v_means, Tensor v_quats, Tensor v_scales)");

  // Depth along each pixel's ray and further channels, blended like `composite`; rays [N, 10] of ray_blending.h. Besides
  // the channels: opacity, mean and median depth, variance of depth, and the list positions of the last blended splat and of the
  // median's splat.
  m.def(
      "blend_rays(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor values, Tensor isect_offsets, "
      "Tensor flatten_ids, int width, int height, float max_alpha=0.99) -> (Tensor values, Tensor alphas, Tensor depths, "
      "Tensor medians, Tensor variances, Tensor last, Tensor median_at)");
  // Largest blending weight [N] of each splat over the pixels; arguments as for blend_rays.
  m.def(
      "splat_contributions(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor values, Tensor isect_offsets, "
      "Tensor flatten_ids, int width, int height, float max_alpha=0.99) -> Tensor");
  m.def(
      "blend_rays_backward(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor values, Tensor isect_offsets, "
      "Tensor flatten_ids, int width, int height, Tensor alphas, Tensor depths, Tensor last, Tensor median_at, Tensor v_values, "
      "Tensor v_alphas, Tensor v_depths, Tensor v_medians, float max_alpha=0.99) -> (Tensor v_means2d, Tensor v_conics, "
      "Tensor v_opacities, Tensor v_rays, Tensor v_values)");

  // Projection of N surfels in B batches to C cameras: centres of the boxes, depths, ray transforms [B, C, N, 3, 3], normals
  // in camera axes and radii.
  m.def(
      "project_surfels(Tensor means, Tensor quats, Tensor scales, Tensor viewmats, Tensor Ks, int width, int height, "
      "float near_plane, float far_plane, float radius_clip) -> (Tensor means2d, Tensor depths, Tensor ray_transforms, "
      "Tensor normals, Tensor radii)");
  m.def(
      "project_surfels_backward(Tensor means, Tensor quats, Tensor scales, Tensor viewmats, Tensor Ks, Tensor radii, "
      "Tensor? v_means2d, Tensor? v_depths, Tensor? v_ray_transforms, Tensor? v_normals, bool needs_viewmats) -> "
      "(Tensor v_means, Tensor v_quats, Tensor v_scales, Tensor v_viewmats)");

  // Alpha compositing of surfels at the intersections of rays. Besides colours, alphas and normals: distortion and median of
  // the last colour channel, the sum of weight times that channel relative to the first surfel of the tile, and the list
  // positions of the last blended surfel and of the median's. `densify` and `absgrad_probe` are unread inputs with gradients.
  m.def(
      "blend_surfels(Tensor means2d, Tensor ray_transforms, Tensor colors, Tensor opacities, Tensor normals, Tensor densify, "
      "Tensor isect_offsets, Tensor flatten_ids, Tensor? backgrounds, Tensor? masks, Tensor? absgrad_probe, int width, "
      "int height, int tile_size, float max_alpha=0.99) -> (Tensor colors, Tensor alphas, Tensor normals, Tensor distortions, "
      "Tensor medians, Tensor depth_sums, Tensor last, Tensor median_at)");
  m.def(
      "blend_surfels_backward(Tensor means2d, Tensor ray_transforms, Tensor colors, Tensor opacities, Tensor normals, "
      "Tensor isect_offsets, Tensor flatten_ids, Tensor? backgrounds, Tensor? masks, int width, int height, int tile_size, "
      "Tensor alphas, Tensor depth_sums, Tensor last, Tensor median_at, Tensor v_colors, Tensor v_alphas, Tensor v_normals, "
      "Tensor v_distortions, Tensor v_medians, bool absgrad, float max_alpha=0.99) -> (Tensor v_means2d, "
      "Tensor v_ray_transforms, Tensor v_colors, Tensor v_opacities, Tensor v_normals, Tensor v_densify, Tensor v_backgrounds, "
      "Tensor v_means2d_abs)");

  // Fused `rasterization()`, CUDA only; gsplat_core/ops/rasterization/__init__.py documents the list arguments.
  m.def("rasterize(Tensor?[] inputs, int[] image_dims, int[] options, float[] ranges, bool training) -> Tensor[]");
  m.def(
      "rasterize_splats_backward(Tensor?[] saved, Tensor? v_image, Tensor? v_alphas, int[] image_dims, int[] options, "
      "float[] ranges) -> (Tensor v_records, Tensor v_means2d, Tensor v_absolute)");
  m.def(
      "rasterize_inputs_backward(Tensor?[] inputs, Tensor radii, Tensor? row_of, Tensor?[] gradients, int[] image_dims, "
      "int[] options, float[] ranges, bool[] needs) -> Tensor[]");

  // Render one frame from raw Gaussians, CUDA only: image [H, W, 4] with depth, and the tensors needed for its
  // gradient. gaussians: means, quats, log_scales, logit_opacities, sh. mode: 0 tile lists in one shared buffer, 1 the
  // same for training, 2 one fixed segment per tile.
  m.def(
      "render_frame(Tensor[] gaussians, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, int width, int height, "
      "float eps2d, float near_plane, float far_plane, int camera_model, int capacity, int mode) -> (Tensor image, "
      "Tensor alphas, Tensor last, Tensor records, Tensor tile_offsets, Tensor sorted, Tensor splat_starts, "
      "Tensor instance_splats, Tensor status)");
  // Render one frame of weighted sums, CUDA only: image [H, W, 4] with depth. gaussians as in render_frame. scalars:
  // sigma, the unit of depths, and the weight of the background, each one number on the device.
  m.def(
      "render_weighted_frame(Tensor[] gaussians, Tensor opacity_harmonics, Tensor factors, Tensor[] scalars, Tensor viewmat, "
      "Tensor K, Tensor? background, int width, int height, float eps2d, float near_plane, float far_plane, int camera_model, "
      "float least_total, float least_share, int capacity) -> (Tensor image, Tensor alphas, Tensor status)");
  // Gradient of render_frame: of the raw parameters in the layout of raw_layout.h, and of sh if it has more than one
  // basis. forward: the results of render_frame in training mode, without the image.
  m.def(
      "render_frame_backward(Tensor[] gaussians, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, "
      "Tensor[] forward, Tensor v_image, Tensor? v_alphas, float eps2d, int camera_model, bool deterministic) -> "
      "(Tensor v_raw, Tensor v_sh)");
  // Gradient of render_frame followed by one in-place Adam step of the Gaussians. rates [5] and step [1] are read from
  // device memory; the numbers of skipped rows are added to skipped [5]. v_raw is empty unless requested. With
  // residuals [H, W, 4] and relaxation [1], the colour columns of v_raw hold colour corrections to be added, and sh is
  // unchanged.
  m.def(
      "render_frame_backward_adam_(Tensor(a!)[] gaussians, Tensor(b!)[] first_moments, Tensor(c!)[] second_moments, Tensor "
      "rates, "
      "Tensor step, Tensor(d!) skipped, Tensor? deltas, Tensor viewmat, Tensor K, Tensor? background, Tensor[] forward, "
      "Tensor v_image, Tensor? v_alphas, Tensor? residuals, Tensor? relaxation, Tensor? added, float eps2d, int camera_model, "
      "float beta1, float beta2, float epsilon, bool needs_raw, bool deterministic) -> Tensor v_raw");

  // Accumulate a frame's status [4] in `totals`: the maximum of every entry, except that overflows are counted. If this
  // frame did not overflow, increment step and return fits [1] = 1, otherwise 0.
  m.def("accumulate_status_(Tensor status, Tensor(a!) totals, Tensor(b!) step) -> Tensor fits");

  // Deformation by per-Gaussian basis functions of time: deltas [N, 13] at tau, their gradients, and gradients with
  // lazy Adam. tau and the six learning rates (position, rotation, log-scale, colour, centres, widths) are float32 on
  // the field's device. Deltas and gradients may be padded to the 16 columns of render_frame.
  m.def("basis_field(Tensor centers, Tensor log_widths, Tensor weights, Tensor tau, bool padded=False) -> Tensor");
  m.def(
      "basis_field_backward(Tensor gradient, Tensor centers, Tensor log_widths, Tensor weights, Tensor tau) "
      "-> (Tensor, Tensor, Tensor)");
  m.def(
      "basis_field_backward_adam_(Tensor gradient, Tensor tau, Tensor(a!) centers, Tensor(b!) log_widths, Tensor(c!) weights, "
      "Tensor(d!) m_centers, Tensor(e!) m_log_widths, Tensor(f!) m_weights, Tensor(g!) v_centers, Tensor(h!) v_log_widths, "
      "Tensor(i!) v_weights, Tensor(j!) steps, Tensor rates, float beta1, float beta2, float epsilon) -> ()");
  m.def("basis_field_add_colours_(Tensor centers, Tensor log_widths, Tensor(a!) weights, Tensor tau, Tensor change) -> ()");

  // Minimum-norm change of the weights such that the deltas at tau equal `target` [N, 13].
  m.def("basis_field_move_to_(Tensor centers, Tensor log_widths, Tensor(a!) weights, Tensor tau, Tensor target) -> ()");

  // World-space motion of points [N, 3] under optical flow [h, w, 2] between two images. The points are given at the
  // time of the first image, or of the second if `arrived`. A camera is 18 numbers: three rows of world-to-camera, fx,
  // fy, cx, cy, width, height. CPU only.
  m.def("surface_motion(Tensor points, Tensor flow, float[] before, float[] after, bool arrived) -> Tensor");

  // Positions [N, T, 3] of points [N, 3] after each of the flows [T, h, w, 2] between images seen by `views` [T + 1, 18].
  m.def("surface_path(Tensor points, Tensor flows, Tensor views) -> Tensor");

  // Affine motion [N, 3, 3] around points from their neighbours (int32 [N, K]) at two times, for the CPU.
  m.def("neighbour_motion(Tensor before, Tensor after, Tensor turned, Tensor neighbours, float stiffness) -> Tensor");
  m.def(
      "neighbour_motion_backward(Tensor before, Tensor neighbours, float stiffness, Tensor v_out) -> (Tensor v_after, Tensor "
      "v_turned)");

  // Robust reprojection error of camera poses [C, 4, 4] and points [P, 3], and the normal equations of its minimum, in
  // float64 for the CPU. Observation m of `camera` and `point` (int32 [M]) has the ray rays[m] (x / z, y / z).
  // bundle_equations: S [C, 6, C, 6] and right [C, 6] of the cameras with the points eliminated, and for the points
  // V^-1 [P, 3, 3], h [P, 3] and W [M, 6, 3]. place_camera: the pose of one camera that sees all points, which are fixed.
  m.def(
      "bundle_cost(Tensor poses, Tensor points, Tensor camera, Tensor point, Tensor rays, float focal_px, float spread_px, "
      "float flat_px) -> Tensor");
  m.def(
      "bundle_equations(Tensor poses, Tensor points, Tensor camera, Tensor point, Tensor rays, float focal_px, float "
      "spread_px, float flat_px, float damping) -> (Tensor S, Tensor right, Tensor inverse, Tensor h, Tensor coupling)");
  m.def("place_camera(Tensor pose, Tensor points, Tensor rays, float focal_px, float spread_px, int rounds) -> Tensor");

  // Plane sweep over D fronto-parallel planes for the CPU (plane_sweep.h). Pictures and masks are uint8: reference and usable
  // [H, W], views and views_usable [V, H, W]. homographies: float64 [D, V, 3, 3], from pixels of the reference to pixels
  // of a view. sweep_planes: costs int16 [H, W, D] in units of 1/20000, and numbers of agreeing views uint8 [H, W, D].
  // select_planes: per pixel the label, its uniqueness, cost and agreeing views, by semi-global matching.
  m.def(
      "sweep_planes(Tensor reference, Tensor usable, Tensor views, Tensor views_usable, Tensor homographies) -> (Tensor costs, "
      "Tensor votes)");
  m.def("select_planes(Tensor costs, Tensor votes) -> (Tensor labels, Tensor unique, Tensor cost, Tensor agreeing)");

  // Blended optical flow of splats that carry the surface of the first picture to the second camera: [height, width, 4],
  // the sums of weight times flow x, flow y and depth in the second camera, and of the weights. intrinsics: fx, fy,
  // cx, cy of both cameras. Tiles have 16x16 pixels.
  m.def(
      "blend_flow(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor planes, Tensor isect_offsets, "
      "Tensor flatten_ids, float[] intrinsics, int width, int height) -> Tensor");
  m.def(
      "blend_flow_backward(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor planes, Tensor isect_offsets, "
      "Tensor flatten_ids, float[] intrinsics, int width, int height, Tensor v_out) -> Tensor");

  // Semi-global matching of two rectified grey images uint8 [H, W] over the disparities lowest .. lowest + count - 1.
  // Returns the disparity in 1/16 pixel, int32 [H, W], with INT32_MIN where unknown; and uint8 [H, W], 1 for pixels
  // with neither a disparity jump nor a hole nearby.
  m.def("match_disparities(Tensor left, Tensor right, int lowest, int count) -> (Tensor, Tensor)");
  // Subpixel refinement of match_disparities: disparity and its standard deviation in pixels, [H, W] each; 0 and
  // infinity where unknown.
  m.def("fit_disparities(Tensor left, Tensor right, Tensor sixteenths) -> (Tensor, Tensor)");

  // Edge-aware smoothing of planes [C, H, W]. The strength between neighbouring pixels is multiplied by
  // exp(-d / grey_step), where d is their difference in the guide, uint8 [H, W] or [H, W, channels], in grey values.
  m.def("smooth_within_edges(Tensor planes, Tensor guide, float strength, float grey_step) -> Tensor");

  // Histograms [width, bins] of the depth along the pixels' rays, summed over each picture column. A splat adds its
  // blending weight. Splats, lists and rays [N, 10] are those of blend_rays. factors [height, width] multiply the depth
  // of a pixel; 0 excludes the pixel.
  m.def(
      "range_histogram(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor isect_offsets, Tensor flatten_ids, "
      "Tensor? factors, float nearest, float bin, int bins, int width, int height, float max_alpha=0.99) -> Tensor");
  m.def(
      "range_histogram_backward(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor isect_offsets, "
      "Tensor flatten_ids, Tensor? factors, Tensor gradient, float nearest, float bin, int bins, int width, int height, "
      "float max_alpha=0.99) -> (Tensor v_means2d, Tensor v_conics, Tensor v_opacities, Tensor v_rays)");

  // Splat regression f(x) = sum of v g(x) at points [n, d], d = 1 to 4, for k splats with centres [k, d], factors A [k, d, d]
  // and values [k, m]; g = |det A|^-1 N(A^-1 (x - b)). The backward pass takes dL/df [n, m].
  m.def("splat_regression(Tensor points, Tensor centres, Tensor factors, Tensor values) -> Tensor");
  m.def(
      "splat_regression_backward(Tensor points, Tensor centres, Tensor factors, Tensor values, Tensor gradient) -> "
      "(Tensor v_centres, Tensor v_factors, Tensor v_values)");
  // Sums over splats without an order, planes [D + 1, H, W]: of weight times opacity times Gaussian times channel, and of
  // the same without the channel. Added in fixed point, so that the order of the splats does not matter.
  m.def(
      "weighted_sums(Tensor means2d, Tensor conics, Tensor channels, Tensor opacities, Tensor weights, Tensor isect_offsets, "
      "Tensor flatten_ids, int width, int height) -> Tensor");
  m.def(
      "weighted_sums_backward(Tensor means2d, Tensor conics, Tensor channels, Tensor opacities, Tensor weights, Tensor "
      "isect_offsets, Tensor flatten_ids, int width, int height, Tensor v_sums) -> (Tensor v_means2d, Tensor v_conics, Tensor "
      "v_channels, Tensor v_opacities, Tensor v_weights)");

  // Unit normals [I, H, W, 3] in world axes of depth maps [I, H, W]; the backward pass returns dL/ddepths.
  m.def("depth_to_normal(Tensor depths, Tensor camtoworlds, Tensor Ks) -> Tensor");
  m.def("depth_to_normal_backward(Tensor v_normals, Tensor depths, Tensor camtoworlds, Tensor Ks) -> Tensor");

  // Structural similarity per pixel and channel of [H, W, C] images.
  m.def("ssim_map(Tensor image, Tensor target) -> Tensor");
  m.def("ssim_map_backward(Tensor gradient, Tensor image, Tensor target) -> Tensor");
  // Mean of the map without the pixels that are closer to the edge than `border`.
  m.def("ssim_mean(Tensor image, Tensor target, int border) -> Tensor");
  m.def("ssim_mean_backward(Tensor gradient, Tensor image, Tensor target, int border) -> Tensor");

  // Loss over tissue pixels and its gradients: (loss, [l1 or squared error, 1 - ssim, inverse-depth l1], dL/dimage,
  // dL/ddepth or empty).
  m.def(
      "image_loss(Tensor image, Tensor target, Tensor? mask, Tensor? depth, Tensor? target_depth, float ssim_weight, "
      "float depth_weight, bool squared=False) -> (Tensor, Tensor, Tensor, Tensor)");

  // Losses of the surface along rays over tissue, with their gradients: (loss, dL/ddepths) and (loss, dL/ddepths, dL/dalphas,
  // dL/dnormals).
  m.def("ray_depth_loss(Tensor depths, Tensor known, Tensor tissue) -> (Tensor, Tensor)");
  m.def(
      "ray_normal_loss(Tensor depths, Tensor alphas, Tensor normals, Tensor tissue, Tensor K, int camera_model) -> (Tensor, "
      "Tensor, Tensor, Tensor)");

  // Loss over tissue pixels and its gradients for the output of render_frame: image [H, W, 4] with colours and the
  // weighted sum of z, alphas [H, W]. Returns (loss, terms, dL/dimage, dL/dalphas).
  m.def(
      "frame_loss(Tensor image, Tensor alphas, Tensor target, Tensor? mask, Tensor? target_depth, float ssim_weight, "
      "float depth_weight, bool squared=False) -> (Tensor, Tensor, Tensor, Tensor)");

  // Write up to 64 numbers, passed as kernel arguments, to device memory without a copy from the host.
  m.def("store_scalars_(Tensor(a!) to, float[] values) -> ()");

  // HexPlane features of one level: the product of six plane samples [N, C], its gradients, and the two halves of
  // factorised inference.
  m.def("hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def(
      "hexplane_features_backward(Tensor gradient, Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, "
      "Tensor zt) -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)");
  m.def("hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) -> Tensor");
  m.def("hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) -> Tensor");
  m.def("hexplane_decode(Tensor[] spaces, Tensor coordinates, Tensor[] lines, Tensor[] weights, Tensor[] biases) -> Tensor");
  // Deltas [N, 16] of the field at `time`, from cached space features [N, C] in float32 or float16; row i is Gaussian
  // order[i]. CUDA only.
  m.def(
      "hexplane_deltas(Tensor[] spaces, Tensor coordinates, Tensor? order, Tensor time, Tensor[] time_planes, Tensor[] weights, "
      "Tensor[] biases) -> Tensor");
  // Training of the whole field without autograd, CUDA only; ops/hexplane_training/__init__.py documents the
  // lists. `state` is the tensors that hexplane_train returns after the deltas. `gradient` is the tensors that its backward
  // pass returns after the network's gradient, plus starts.
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

  // Random samples of splats without sorting: adds red, green, blue, hits and z of each pixel to `sums` [H, W, 5].
  // ops/stochastic/__init__.py documents the lists.
  m.def("splat_samples_(Tensor?[] scene, Tensor viewmat, Tensor intrinsics, Tensor(a!) sums, int[] options) -> ()");
  // `count` Poisson draws for each of the rates (float64 [R]), as int64 [R, count].
  m.def("poisson_draws(Tensor rates, int count, int seed) -> Tensor");
}
