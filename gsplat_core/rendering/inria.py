"""Stand-in for the renderer of the INRIA trainer with the arguments of gsplat's wrapper of it."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.rendering.settings import EPS2D, NEAR_PLANE


def rasterization_inria_wrapper(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    far_plane: float = 100.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    **kwargs: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render with `rasterization`, as a stand-in for the renderer of the INRIA trainer, which is not part of this package.

    Arguments and results are those of gsplat's function of this name: a picture, its opacities and an empty dict.
    Further arguments are ignored, as there.
    """
    colours, alphas, _ = rasterization(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d=eps2d,
        sh_degree=sh_degree, packed=False, backgrounds=backgrounds,
    )  # fmt: skip
    return colours, alphas, {}
