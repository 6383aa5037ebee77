"""Warm-up before a stream, so that no frame waits for initialisation."""

from __future__ import annotations

from gsplat_core.scene.cameras import Camera
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from gsplat_core.training.upkeep import Upkeep
from operators.reconstruct import warm_reconstructor


def test_warm_reconstructor_runs_upkeep_per_scene_and_leaves_no_gaussians(monkeypatch):
    done = []
    once = Upkeep.once

    def noted(self, step, observation, last_seen=None):
        before = step.gaussians.means.clone()
        once(self, step, observation, last_seen)
        done.append(len(before) != step.gaussians.count or not bool((before == step.gaussians.means).all()))

    monkeypatch.setattr(Upkeep, "once", noted)
    config = ReconstructorConfig(gaussians=120, max_gaussians=240, history_s=1.0, preallocate=True)
    reconstructor = Reconstructor(config, Camera.from_focal(50.0, 48, 40), live=LiveTraining())
    drawn = []
    warm_reconstructor(reconstructor, lambda frame, model: drawn.append(model))
    assert done == [True, True] and len(drawn) == 5
    assert reconstructor.gaussians == 0
