"""A reconstructor refuses invalid input and leaves its model unchanged."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor

CONFIG = ReconstructorConfig(gaussians=400, max_gaussians=800, first_frame_steps=20, steps_per_frame=6)


def test_observe_refuses_first_frame_without_training(make_frame, camera):
    learning = Reconstructor(CONFIG, camera)
    with pytest.raises(InvalidInput, match="frame 0 is the first one"):
        learning.observe(make_frame(), train=False)
    with pytest.raises(InvalidInput, match="observe a frame first"):
        learning.snapshot()
    assert learning.gaussians == 0


def test_observe_refuses_invalid_frames_and_keeps_model(make_frame, camera):
    learning = Reconstructor(dataclasses.replace(CONFIG, first_frame_steps=2), camera)
    learning.observe(make_frame(4))
    digest = learning.snapshot().sha256()
    with pytest.raises(InvalidInput, match=r"frame 3 is at 0.150 s, before the last one at 0.200 s"):
        learning.observe(make_frame(3))
    with pytest.raises(InvalidInput, match="frame 5 is 24x20, its camera 48x40"):
        learning.observe(make_frame(5, width=24, height=20))
    with pytest.raises(InvalidInput, match="not finite"):
        learning.observe(make_frame(5, pose=np.full((4, 4), np.nan)))
    with pytest.raises(InvalidInput, match="steps is -2"):
        learning.observe(make_frame(4), steps=-2)
    assert learning.snapshot().sha256() == digest


@pytest.mark.parametrize(
    ("seqs", "steps", "message"), [((), 5, "no frames"), ((0, 2, 1), 5, "in order"), ((0,), 0, "steps is 0")]
)
def test_fit_refuses_invalid_frames_or_steps(make_frame, camera, seqs, steps, message):
    with pytest.raises(InvalidInput, match=message):
        Reconstructor(CONFIG, camera).fit([make_frame(seq) for seq in seqs], steps)
