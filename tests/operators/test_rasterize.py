"""Rendering gives what is displayed: bytes, depth in the scene's unit, opacity."""

from __future__ import annotations

import numpy as np
import torch

from operators.messages import DeformedScene
from operators.rasterize import RasterizeOp, displayed


def test_a_scene_made_from_a_frame_looks_like_it(frame, model, camera, compute):
    scene = DeformedScene(frame(), model(4), camera, True)
    (shown,) = compute(RasterizeOp(None), scene=scene)
    assert shown.image.dtype == np.uint8 and shown.image.shape == frame().image.shape
    assert shown.model_version == 4 and shown.trained
    covered = shown.alpha > 0.5
    assert covered.mean() > 0.5
    np.testing.assert_allclose(shown.depth[covered], 50, atol=0.5)
    assert np.abs(shown.image.astype(int) - frame().image)[covered].mean() < 60


def test_displayed_clips_and_rounds_to_nearest():
    image = torch.tensor([[[-1.0, 0.0, 0.5 / 255 + 1e-4], [1.0, 2.0, 0.4 / 255]]])
    np.testing.assert_array_equal(displayed(image), [[[0, 0, 1], [255, 255, 0]]])
