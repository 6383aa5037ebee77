"""A reconstructor that has done everything once before its first frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from gsplat_core.training.budget import Budget
from gsplat_core.training.live import LiveReconstructor

WARM_FRAMES = 4
WARM_STEPS = {"cpu": 3, "cuda": 40}
"""Optimiser steps on each picture before the first frame."""
EYES_APART = 0.07
"""Of the scene's distance, where nothing is known of the stream's eyes yet."""


def warm_reconstructor(
    reconstructor: LiveReconstructor,
    draw: Callable[[Frame, Model | Snapshot], object] = lambda *_: None,
    *,
    stereo: bool = False,
) -> None:
    """Train on noise and forget it; `draw` is given each picture and its model. stereo: as in a stream that has pictures of a right eye.

    Replay of a recorded session does the same: a GPU's tile lists, which noise has made longer, decide which steps are taken again.
    """
    image = noise(reconstructor.camera)
    height, width = image.shape[:2]
    tissue = np.ones((height, width), np.uint8)
    tissue[height // 2 :, : width // 2] = 0  # a scene starts in another way where tools hide some of it
    depth = np.full((height, width), reconstructor.config.default_depth_mm, np.float32)
    drawn: list[object] = []
    for frames in (WARM_FRAMES, 1):  # the second scene takes over the memory of the first one, as the stream's does
        for seq in range(frames):
            frame = Frame(seq, seq * 33_000_000, image, mask=tissue)
            if stereo:
                right = reconstructor.camera.right_eye(EYES_APART * reconstructor.config.default_depth_mm)
                frame = frame.with_fields(right_image=image, right_camera=right)
            # Budgets in time, so that the length of a step is known.
            reconstructor.observe(frame, budget=Budget.until(0.0, at_least=WARM_STEPS[reconstructor.device.type]))
            # All of them are held: every snapshot and piece of page-locked memory that a run needs is made.
            model = reconstructor.publish()
            drawn.append((model, draw(frame, model)))
            # Steps that look at depth are captured by themselves.
            reconstructor.take_depth(frame.with_fields(depth=depth, depth_origin=DepthOrigin.STEREO))
            reconstructor.rehearse(2)
            reconstructor.grow(frame)
        reconstructor.look_after_once()
        reconstructor.forget()


def noise(camera: Camera) -> NDArray[np.uint8]:
    """A picture of the camera's size that is like no other."""
    return np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3), np.uint8)
