"""Gaussian point splatting (Rijsdijk et al., TOG 2026): a `Renderer` that draws random points of each Gaussian."""

from __future__ import annotations

from gsplat_core.rendering.renderer import STANDARD_OUTPUTS, Capabilities
from gsplat_core.rendering.stochastic import SampledRenderer


class PointRenderer(SampledRenderer):
    """Renderer that draws a Poisson number of points from every splat and keeps the nearest one of each sub-pixel.

    Its expectation is alpha blending with each splat's density integrated over the sub-pixel, which approaches
    `AlphaRenderer` with increasing `supersampling`.
    """

    name = "points"
    method = "points"
    capabilities = Capabilities(
        outputs=STANDARD_OUTPUTS,
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "supersampling", "seed", "progressive", "storage"),
    )
