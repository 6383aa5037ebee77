"""CONTRIBUTING's recipe "A renderer", followed by a test alone: points, one per Gaussian, run through a replay."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

import numpy as np
import pytest
import torch

from gsplat_core.choices import RENDERERS
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import synthesize
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import (
    STANDARD_OUTPUTS,
    Capabilities,
    FinishedFrame,
    PendingFrame,
    check_camera,
    checked_outputs,
    new_renderer,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0
from operators.applications.replay import ReplaySettings, replay
from operators.metrics import QualityResult
from operators.reconstruct import ModelResult
from operators.sinks.sink import KeyframesResult


class PointRenderer:
    """Every Gaussian as one pixel of its base colour, the nearest one where several meet."""

    capabilities = Capabilities(
        outputs=("image", "alpha", "depth", "gaussian_ids"),
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=False,
        deterministic=True,
    )
    prepared: ClassVar[list[int]] = []

    def __init__(self, camera: Camera, device: torch.device, *, precision="fp32", background=None) -> None:
        self._camera, self._device = camera, device
        self._model: Model | None = None

    def prepare(self, model: Model) -> None:
        assert isinstance(model, Model)
        self.prepared.append(model.version)
        self._model = model

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        asked = checked_outputs("dots", outputs, self.capabilities)
        check_camera(self._camera, camera)
        gaussians = self._model.at(time_s)
        viewmat, K = camera.matrices(self._device)
        points = gaussians.means @ viewmat[:3, :3].T + viewmat[:3, 3]
        order = points[:, 2].argsort(descending=True)  # far to near, so that the nearest is written last
        u, v, _ = (points @ K.T / points[:, 2:]).floor().long().unbind(1)
        seen = (points[:, 2] > 0) & (u >= 0) & (u < camera.width_px) & (v >= 0) & (v < camera.height_px)
        order = order[seen[order]].cpu()
        pixels = (v * camera.width_px + u).cpu()
        ids = torch.full((camera.height_px * camera.width_px,), -1)
        for index in order.tolist():
            ids[pixels[index]] = index
        shown, chosen = ids >= 0, ids.clamp_min(0).to(self._device)
        shown = shown.to(self._device)
        made = {
            "image": torch.where(shown[:, None], 0.5 + SH_C0 * gaussians.sh[chosen, 0], 0).view(
                camera.height_px, -1, 3
            ),
            "alpha": shown.float().view(camera.height_px, -1),
            "depth": torch.where(shown, points[chosen, 2], 0).view(camera.height_px, -1),
            "gaussian_ids": ids.view(camera.height_px, -1),
        }
        return FinishedFrame({name: made[name] for name in asked})


@pytest.fixture
def points():
    RENDERERS.add("dots", PointRenderer)
    PointRenderer.prepared.clear()
    yield PointRenderer
    RENDERERS.remove("dots")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("recordings") / "tiny", frames=3, width_px=64, height_px=48, stereo=False)


def test_it_runs_through_a_replay(points, tiny, tmp_path, device):
    settings = {"recording": tiny, "device": device.type, "steps_per_frame": 1}
    outcome = replay(ReplaySettings(out=tmp_path / "dots", renderer="dots", **settings))
    quality = outcome.find(QualityResult)
    assert quality.frames == 3 and sorted(set(points.prepared)) == [
        1,
        2,
        3,
    ]  # and again for what is predicted of the next frame
    assert (tmp_path / "dots" / "reconstruction.mp4").exists()
    blended = replay(ReplaySettings(out=tmp_path / "alpha", **settings))
    assert quality.frames_sha256 != blended.find(QualityResult).frames_sha256
    assert outcome.find(ModelResult).model.sha256() == blended.find(ModelResult).model.sha256()
    # A pixel that a Gaussian covers has that Gaussian's depth.
    shown = outcome.find(KeyframesResult).keyframes[0].rendered
    covered = shown.alpha > 0
    assert 0.05 < covered.mean() < 1 and (shown.depth[covered] > 0).all()


def test_its_own_outputs_are_asked_for_by_name(points, tiny, tmp_path):
    outcome = replay(ReplaySettings(recording=tiny, out=tmp_path / "out", steps_per_frame=1))
    model = outcome.find(ModelResult).model
    renderer = new_renderer("dots", model.camera)
    renderer.prepare(model)
    frame = renderer.render(model.camera, 0.0, outputs=["gaussian_ids"])
    assert set(frame.outputs()) == {"image", "gaussian_ids"}
    ids = frame.outputs()["gaussian_ids"].numpy()
    assert len(np.unique(ids)) > 50 and ids.max() < model.gaussians.count


def test_an_unknown_name_is_refused_before_anything_is_written(tiny, tmp_path):
    with pytest.raises(InvalidSetting, match="renderer is 'dots'; choose alpha"):
        replay(ReplaySettings(recording=tiny, out=tmp_path / "out", renderer="dots"))
    assert not (tmp_path / "out").exists()
