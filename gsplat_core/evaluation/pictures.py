"""What a model shows for a frame: the picture that is scored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.rendering.registry import RENDERERS, new_renderer
from gsplat_core.rendering.renderer import Renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot


@dataclass(frozen=True)
class Picture:
    """A rendered picture, in memory of its own."""

    image: NDArray[np.uint8]
    """RGB [H, W, 3] as it is displayed, and as a PNG file would hold it: clipped and rounded to 8 bits."""
    unrounded: NDArray[np.float32]
    """RGB [H, W, 3] in 0..1 before the rounding, clipped."""
    depth: NDArray[np.float32]
    """z [H, W] in the model's unit of length; 0 = nothing there."""
    model_version: int


class PictureMaker:
    """Renders published models for frames: at the frame's time, from its pose, with its exposure. One renderer for all of them."""

    def __init__(self, camera: Camera, device: torch.device | str = "cpu", renderer: str = "alpha") -> None:
        """camera: of the pictures; a frame with a pose of its own is seen from there."""
        self.camera = camera
        self._reads_snapshots = RENDERERS[renderer].capabilities.reads_snapshots
        self._renderer: Renderer = new_renderer(renderer, camera, device)
        self._prepared: Model | Snapshot | None = None

    def __call__(self, model: Model | Snapshot, frame: Frame, camera: Camera | None = None) -> Picture:
        """The model as it would be shown for the frame; with a `camera` of the same size, as that one sees it. Its time is clamped to the
        model's window."""
        if camera is None:
            camera = self.camera if frame.pose is None else self.camera.with_pose(frame.pose)
        with torch.inference_mode():
            if model is not self._prepared:
                self._renderer.prepare(model if self._reads_snapshots else model.as_model())
                # A snapshot's slot is free for training only when nobody holds it.
                self._prepared = model if isinstance(model, Model) else None
            output = self._renderer.render(camera, frame.time_s).result()
            picture = output.image
            if frame.exposure != (1.0, 1.0, 1.0):
                picture = picture * picture.new_tensor(frame.exposure)
            picture = picture.clamp(0, 1)
            rounded = (picture * 255).round().to(torch.uint8)
            return Picture(
                image=np.array(rounded.cpu().numpy()),
                unrounded=np.array(picture.cpu().numpy()),
                depth=np.array(output.depth.cpu().numpy()),
                model_version=model.version,
            )
