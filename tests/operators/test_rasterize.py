"""Rendering gives what is displayed: bytes, depth in the scene's unit, opacity."""

from __future__ import annotations

import numpy as np
import torch

from gsplat_core.rendering.registry import RENDERERS
from gsplat_core.rendering.renderer import Capabilities, FinishedFrame
from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import SnapshotSlots
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
    error = np.abs(shown.image.astype(int) - frame().image)[covered].mean()
    # 60 Gaussians for 384 pixels: 10 grey levels. The picture moved by two pixels scores 19, swapped channels 40, its mean colour 42.
    assert error < 14


def test_displayed_clips_and_rounds_to_nearest():
    image = torch.tensor([[[-1.0, 0.0, 0.5 / 255 + 1e-4], [1.0, 2.0, 0.4 / 255]]])
    np.testing.assert_array_equal(displayed(image), [[[0, 0, 1], [255, 255, 0]]])


def test_a_snapshot_is_shown_as_its_model_is(frame, model, camera, compute):
    published = model(4)
    snapshot = SnapshotSlots("cpu").publish(
        published.gaussians, None, version=4, camera=camera, time_window_s=(0.0, 1.0)
    )
    scenes = [DeformedScene(frame(), shown, camera, True) for shown in (published, snapshot)]
    first, second = (compute(RasterizeOp(None), scene=scene)[0] for scene in scenes)
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_array_equal(first.depth, second.depth)
    assert second.model_version == 4
    assert torch.equal(scenes[1].gaussians.means, scenes[0].gaussians.means)


def test_a_renderer_that_reads_no_snapshots_is_given_models(frame, model, camera, compute):
    prepared = []

    class Grey:
        capabilities = Capabilities(("image",), {"cpu": ("fp32",)}, differentiable=False, deterministic=True)

        def __init__(self, camera, device, **options):
            self.size = camera.height_px, camera.width_px

        def prepare(self, model):
            prepared.append(model)

        def render(self, camera, time_s, outputs=()):
            return FinishedFrame({"image": torch.full((*self.size, 3), 0.5)})

    RENDERERS.add("grey", Grey)
    try:
        snapshot = SnapshotSlots("cpu").publish(
            model().gaussians, None, version=1, camera=camera, time_window_s=(0.0, 1.0)
        )
        (shown,) = compute(RasterizeOp(None, renderer="grey"), scene=DeformedScene(frame(), snapshot, camera, True))
    finally:
        RENDERERS.remove("grey")
    assert [type(given) for given in prepared] == [Model]
    assert (shown.image == 128).all() and not shown.depth.any() and not shown.alpha.any()
