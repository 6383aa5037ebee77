"""Messages reject values that would fail further down the graph."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from operators.messages import DeformedScene, Reconstruction


def test_reconstruction_refuses_training_steps_of_heldout_frame(frame, model):
    with pytest.raises(InvalidInput, match=r"frame 3: a held-out frame had 2 training steps"):
        Reconstruction(frame(3), model(), trained=False, steps=2)


def test_reconstruction_refuses_negative_steps(frame, model):
    with pytest.raises(InvalidInput, match="steps is -1"):
        Reconstruction(frame(), model(), trained=True, steps=-1)


def test_deformed_scene_refuses_camera_of_other_size(frame, model, camera):
    with pytest.raises(InvalidInput, match=r"frame 0 is 24x16 px, its camera 48x32; scale the camera"):
        DeformedScene(frame(), model(), camera.scaled(2), True)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"image": np.zeros((16, 24, 3), np.float32)}, "must be RGB uint8"),
        ({"image": np.zeros((16, 25, 3), np.uint8)}, "must be RGB uint8"),
        ({"depth": np.zeros((24, 16), np.float32)}, "depth is"),
        ({"alpha": np.zeros((1, 1), np.float32)}, "alpha is"),
    ],
)
def test_rendered_frame_refuses_wrong_shapes_and_dtypes(rendered, fields, message):
    with pytest.raises(InvalidInput, match=message):
        rendered(**fields)
