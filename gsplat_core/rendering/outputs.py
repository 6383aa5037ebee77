"""Outputs of a renderer in addition to picture, opacity and depth of the centres."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OutputKind:
    """Meaning of an output, one value or vector per pixel."""

    description: str
    unit: str
    """Unit of the values; empty for numbers without a unit."""
    channels: int | None
    """Number of values per pixel; 1 is an image [H, W], 3 is [H, W, 3]. None if it depends on the model."""
    differentiable: bool
    """True if training can use the output: a function of `gsplat_core.rendering` returns it with gradients."""


RAY_DEPTH = OutputKind(
    "Expected depth z where each ray is closest to the centres of the Gaussians' densities; 0 where unobserved",
    "scene unit", 1, True,
)  # fmt: skip
MEDIAN_DEPTH = OutputKind(
    "Depth z of the Gaussian at which transmittance falls to 1/2; 0 if it never does", "scene unit", 1, True
)
NORMALS = OutputKind("Blended shortest axes of the Gaussians, towards the camera", "", 3, True)
DEPTH_NORMALS = OutputKind("Normals of the surface of ray_depth; 0 at edges", "", 3, True)
SPREAD = OutputKind("Standard deviation of depth along the ray", "scene unit", 1, False)
CONFIDENCE = OutputKind("Opacity, reduced where tissue has not been seen for long", "", 1, False)
SEMANTICS = OutputKind("Blended logits of the classes of a model that was trained with labels", "", None, True)
FLOW = OutputKind(
    "Motion of the surface to the right and down within `FLOW_STEP_S`, for a camera at rest", "px", 2, True
)
OCCLUSION = OutputKind(
    "1 where the surface is hidden or outside of the picture after `FLOW_STEP_S`, else 0", "", 1, False
)

FLOW_STEP_S = 1 / 30
"""Interval in seconds over which the outputs `flow` and `occlusion` show motion."""
FLOW_OUTPUTS = ("flow", "occlusion")
"""Names of the outputs that `render_motion` computes."""
SURFACE_OUTPUTS = (
    "ray_depth", "normals", "median_depth", "spread", "confidence", "depth_normals", "semantics",
)  # fmt: skip
"""Names of the outputs that `render_surface` computes, in the order of `Surface`."""
