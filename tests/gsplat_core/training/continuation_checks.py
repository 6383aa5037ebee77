"""Checks of a published state after its newest frame, for every motion prior."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from gsplat_core.rendering.renderer import new_renderer
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor


def check_published_continuations(
    reconstructor: Reconstructor, frames: Iterable[Frame], camera: Camera, interval_s: float
) -> None:
    """After each frame the renderer shows, an interval later, what a model of the same state computes; the last state moves."""
    renderer = new_renderer("alpha", camera, reconstructor.device)
    for frame in frames:
        reconstructor.observe(frame, steps=4)
        published = reconstructor.publish()
        renderer.prepare(published)
        later_s = frame.time_s + interval_s
        shown = renderer.render(camera, later_s).result().image.cpu()
        expected = published.as_model().to("cpu").render(later_s, depth=False).image
        assert psnr_tissue_db(shown.numpy(), expected.numpy()) > 45
    assert not torch.equal(published.at(frame.time_s).means, published.at(later_s).means)
