"""From Gaussians to a picture at the frame's camera."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.rasterization import render
from gsplat_core.transfers import HostCopy
from operators.graph import Operator, OperatorSpec
from operators.messages import DeformedScene, RenderedFrame


def displayed(image: torch.Tensor) -> NDArray[np.uint8]:
    """A float image [H, W, 3] in 0..1 as it is displayed: RGB uint8, clipped and rounded to nearest."""
    return _displayed(image).numpy()


def _displayed(image: torch.Tensor) -> HostCopy:
    # Rounded where it is: a byte per channel travels, not four.
    return HostCopy((image.clamp(0, 1) * 255).round().to(torch.uint8))


class RasterizeOp(Operator):
    """Renders colour, depth and opacity.

    Inputs:
        scene: `DeformedScene`.

    Outputs:
        rendered: `RenderedFrame`.
    """

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("scene", type=DeformedScene)
        spec.output("rendered", type=RenderedFrame)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        scene: DeformedScene = op_input.receive("scene")
        with torch.inference_mode():
            output = render(scene.gaussians, scene.camera)
            # All three are queued before the first is waited for.
            image, depth, alpha = _displayed(output.image), HostCopy(output.depth), HostCopy(output.alpha)
        op_output.emit(
            RenderedFrame(
                frame=scene.frame,
                image=image.numpy(),
                depth=depth.numpy(),
                alpha=alpha.numpy(),
                model_version=scene.model_version,
                trained=scene.trained,
            ),
            "rendered",
        )
