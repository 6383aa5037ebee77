"""Plain-torch implementations of the compiled operations, for any floating dtype and device.

They are the reference for tests of the compiled ops.
"""

from gsplat_core.ops.plain_torch import (
    basis_field,
    basis_field_add_colours_,
    basis_field_backward,
    basis_field_backward_adam_,
    basis_field_move_to_,
    hexplane_decode,
    hexplane_deltas,
    hexplane_features,
    hexplane_modulate,
    hexplane_space,
)
from gsplat_core.reference.compositing import (
    blend_flow,
    blend_rays,
    correct_colours,
    range_histogram,
    rasterize_to_pixels,
    ray_depth_loss,
    ray_normal_loss,
    splat_rays,
    weighted_sums,
)
from gsplat_core.reference.projection import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    quat_scale_to_covar_preci,
    spherical_harmonics,
)
from gsplat_core.reference.rendering import (
    point_moments,
    rasterization,
    render_frame,
    render_weighted_frame,
    sample_moments,
)
from gsplat_core.reference.splat_regression import splat_regression, splat_regression_gradients
from gsplat_core.reference.stereo import fit_disparities, match_disparities, smooth_within_edges
from gsplat_core.reference.surfels import fully_fused_projection_2dgs, rasterize_to_pixels_2dgs
from gsplat_core.reference.training import (
    accumulate_gradient_norms_,
    adam_step,
    diffuse_positions_,
    frame_loss,
    image_loss,
    ssim_map,
)

__all__ = [
    "accumulate_gradient_norms_",
    "adam_step",
    "basis_field",
    "basis_field_add_colours_",
    "basis_field_backward",
    "basis_field_backward_adam_",
    "basis_field_move_to_",
    "blend_flow",
    "blend_rays",
    "correct_colours",
    "diffuse_positions_",
    "fit_disparities",
    "frame_loss",
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "hexplane_decode",
    "hexplane_deltas",
    "hexplane_features",
    "hexplane_modulate",
    "hexplane_space",
    "image_loss",
    "isect_offset_encode",
    "isect_tiles",
    "match_disparities",
    "point_moments",
    "quat_scale_to_covar_preci",
    "range_histogram",
    "rasterization",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "ray_depth_loss",
    "ray_normal_loss",
    "render_frame",
    "render_weighted_frame",
    "sample_moments",
    "smooth_within_edges",
    "spherical_harmonics",
    "splat_rays",
    "splat_regression",
    "splat_regression_gradients",
    "ssim_map",
    "weighted_sums",
]
