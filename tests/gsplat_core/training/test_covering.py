"""New Gaussians for uncovered tissue: added at once, or with the next frame if another thread creates them."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import torch

from gsplat_core.deformation.basis import BasisField
from gsplat_core.errors import InvalidInput
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import Covering
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.steps.step import TrainingStep

CONFIG = ReconstructorConfig(gaussians=400, max_gaussians=500, default_depth_mm=60.0)


@pytest.fixture
def frame(make_frame):
    return make_frame()


@pytest.fixture
def seen(frame, camera):
    return Observation.of(frame, camera)


@pytest.fixture
def step(frame, camera):
    """Return the training step of a scene that covers the left part of the picture."""
    whole = gaussians_from_frame(frame, camera, 400, sh_degree=0, default_depth_mm=60.0)
    left = whole.select(whole.means[:, 0] / whole.means[:, 2] * 50 + 24 < 30)
    return TrainingStep(left, BasisField(left.count, (0.0, 1.0)), CONFIG, camera)


def covering(config=CONFIG, *, beside):
    made = Covering(config, beside=beside)
    made.begin(None, torch.device("cpu"), 0)
    return made


def test_covering_beside_training_adds_same_gaussians_later(step, seen, frame, camera):
    first = step.gaussians.count
    late = covering(beside=True)
    late.check(step, seen, lambda: frame)
    assert step.gaussians.count == first, "training goes on without them"
    late.join(step)
    joined = step.gaussians
    assert joined.count > first + 50
    late.join(step)
    assert step.gaussians.count == joined.count, "each joins once"
    late.check(step, seen, lambda: frame)
    late.join(step)
    assert step.gaussians.count == joined.count, "nothing is left uncovered"
    step.remove(torch.arange(joined.count) >= first)
    covering(beside=False).check(step, seen, lambda: frame)
    assert all(torch.equal(a, b) for a, b in zip(step.gaussians.left_tensors, joined.left_tensors, strict=True))


def test_pending_covering_of_left_scene_is_discarded(step, seen, frame):
    first, late = step.gaussians.count, covering(beside=True)
    gate = threading.Event()

    def pictures():
        assert gate.wait(300)
        return frame

    late.check(step, seen, pictures)
    late.begin(None, torch.device("cpu"), 0)
    gate.set()
    late.join(step)
    assert step.gaussians.count == first


@pytest.mark.parametrize("room", [1, 20])
def test_concurrent_coverings_respect_max_gaussians(step, seen, frame, room):
    first = step.gaussians.count
    config = ReconstructorConfig(gaussians=first, max_gaussians=first + room)
    late = covering(config, beside=True)
    for _ in range(2):
        late.check(step, seen, lambda: frame)
    late.join(step)
    assert step.gaussians.count <= config.max_gaussians
    late.check(step, seen, lambda: frame)
    late.join(step)
    assert step.gaussians.count <= config.max_gaussians


def test_covering_thread_error_is_raised_at_join(step, seen):
    late = covering(beside=True)

    def pictures():
        raise InvalidInput("no picture")

    late.check(step, seen, pictures)
    with pytest.raises(InvalidInput, match="no picture"):
        late.join(step)
    late.join(step)
    assert np.isfinite(step.gaussians.means.numpy()).all()
