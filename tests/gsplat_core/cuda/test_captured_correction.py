"""Depth correction of a scene in one graph launch, compared with separate launches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.observations import Observation
from gsplat_core.training.placement import CapturedCorrection, _correct_at
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from tests.gsplat_core.training.test_late_depth import CAMERA, found, frame_at

FRAME = frame_at(2)


@pytest.fixture
def step(gpu):
    """Return the training step of a scene at 80 mm that has unused rows."""
    config = ReconstructorConfig(gaussians=300, max_gaussians=400, preallocate=True, depth_weight=0.1)
    made = Reconstructor(config, CAMERA, device="cuda", live=LiveTraining())
    for k in range(3):
        made.observe(frame_at(k), steps=3)
    made.take_depth(found(frame_at(1)))
    return made._step


def sloping(gpu, hole=False):
    """Depth that is off by up to a fifth, more to the right."""
    depth = 80 * np.broadcast_to(np.linspace(0.9, 1.2, CAMERA.width_px, dtype=np.float32), FRAME.image.shape[:2]).copy()
    if hole:
        depth[10:30, 12:24] = 0
    return torch.from_numpy(depth).to(gpu)


@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("later_s", [0.0, 0.1])
def test_captured_correction_equals_separate_launches(gpu, step, hole, later_s):
    observation = Observation.of(found(FRAME, origin=DEPTH_ORIGINS["stereo"]), CAMERA, gpu)
    weights, depth = step.field.weights.data, sloping(gpu, hole)
    before = weights.clone()
    captured = CapturedCorrection(step.fixed_rows, step.capabilities.captured_motion, CAMERA)
    for _ in range(3):  # as it is captured, and twice as it was
        start = weights.clone()
        captured(observation, depth, observation.time_s + later_s)
        seen = weights.clone()
        weights.copy_(start)
        with torch.no_grad():
            _correct_at(step, step.capabilities.motion, observation, depth, observation.time_s + later_s)
        torch.testing.assert_close(seen, weights, rtol=1e-3, atol=1e-4)
    count = step.gaussians.count
    assert float((weights[:count] - before[:count]).abs().max()) > 1
    assert torch.equal(weights[count:], before[count:]), "rows that are not in use stay as they are"


def test_captured_correction_skips_overflowing_frame_then_recovers(gpu, step):
    observation = Observation.of(found(FRAME, origin=DEPTH_ORIGINS["stereo"]), CAMERA, gpu)
    weights, depth = step.field.weights.data, sloping(gpu)
    captured = CapturedCorrection(step.fixed_rows, step.capabilities.captured_motion, CAMERA)
    captured._capacity = 1
    before = weights.clone()
    captured(observation, depth, observation.time_s)
    torch.testing.assert_close(weights, before, rtol=0, atol=1e-5)
    captured(observation, depth, observation.time_s)
    assert float((weights - before).abs().max()) > 1
