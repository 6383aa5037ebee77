"""Warm-up of a reconstructor before its first frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsplat_core.models.model import Model
from gsplat_core.models.snapshots import Snapshot
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.budget import Budget
from gsplat_core.training.reconstructor import Reconstructor

WARM_FRAMES = 4
WARM_STEPS = {"cpu": 3, "cuda": 40}
"""Optimiser steps on each warm-up picture."""
EYES_APART = 0.07
"""Stereo baseline of the warm-up as a share of the scene's distance."""


def warm_reconstructor(
    reconstructor: Reconstructor,
    draw: Callable[[Frame, Model | Snapshot], object] = lambda *_: None,
    *,
    stereo: bool = False,
) -> None:
    """Train on noise and reset the model, so that all one-time initialisation is done.

    A replay of a recorded session performs the same warm-up. On a GPU, noise enlarges the tile
    lists, whose capacity determines which steps are repeated.

    Args:
        reconstructor: the new reconstructor.
        draw: called with each warm-up frame and its model.
        stereo: include pictures of a right eye.
    """
    image = noise(reconstructor.camera)
    height, width = image.shape[:2]
    tissue = np.ones((height, width), np.uint8)
    tissue[height // 2 :, : width // 2] = 0  # a tool, so that the code for hidden tissue runs, too
    depth = np.full((height, width), reconstructor.config.default_depth_mm, np.float32)
    drawn: list[object] = []
    for frames in (WARM_FRAMES, 1):  # the second scene runs the code that reuses memory
        for seq in range(frames):
            frame = Frame(seq, seq * 33_000_000, image, mask=tissue)
            if stereo:
                right = reconstructor.camera.right_eye(EYES_APART * reconstructor.config.default_depth_mm)
                frame = frame.with_fields(right_image=image, right_camera=right)
            # A time budget makes the reconstructor measure the duration of a step.
            reconstructor.observe(frame, budget=Budget.until(0.0, at_least=WARM_STEPS[reconstructor.device.type]))
            # All models are held, so that every snapshot slot and pinned buffer of a run is
            # allocated.
            model = reconstructor.publish()
            drawn.append((model, draw(frame, model)))
            # Steps with depth are captured as a separate graph.
            reconstructor.take_depth(frame.with_fields(depth=depth))
            reconstructor.rehearse(2)
            reconstructor.grow(frame)
        reconstructor.look_after_once()
        reconstructor.forget()


def noise(camera: Camera) -> NDArray[np.uint8]:
    """Return a picture of uniform noise of the camera's size, uint8 RGB [H, W, 3]."""
    return np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3), np.uint8)
