"""Path of a scope through a recording without poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.poses.camera_path import MOVING_SHARE, CameraPath, camera_path_of, rigid_share
from gsplat_core.poses.se3 import exp
from tests.gsplat_core.geometry.moving_scope import FIRST, SIDEWAYS, depth_of_surface, video


@pytest.fixture(scope="module")
def frames():
    return [frame.with_fields(seq=n, pts_ns=n * 100_000_000) for n, frame in enumerate(video(12, SIDEWAYS)[0])]


def test_only_a_moving_scope_moves_the_picture_rigidly(frames):
    assert rigid_share(frames) > MOVING_SHARE
    still = [frames[0].with_fields(seq=frame.seq, pts_ns=frame.pts_ns) for frame in frames]
    assert rigid_share(still) == 0.0
    # Stripes of tissue that move by different amounts, before a scope at rest.
    columns = np.arange(FIRST.width_px)
    pulled = [
        frame.with_fields(image=frames[0].image[:, (columns - 3 * n * (columns // 40 % 2)) % FIRST.width_px])
        for n, frame in enumerate(frames)
    ]
    assert rigid_share(pulled) < MOVING_SHARE


def test_frames_that_were_not_read_get_poses_between_their_neighbours():
    twists = torch.tensor([[0.0] * 6, [0.2, 0.0, 0.1, 0.0, 0.1, 0.0]], dtype=torch.float64)
    ends = exp(twists).numpy()
    path = CameraPath(np.array([1.0, 2.0, 3.0]), np.stack([ends[0], np.eye(4) * 7, ends[1]]), None)
    assert np.array_equal(path.at(0.0), ends[0]) and np.array_equal(path.at(9.0), ends[1])
    assert np.array_equal(path.at(2.0), np.eye(4) * 7)
    np.testing.assert_allclose(path.interpolated(2.0), exp(0.5 * twists[1]).numpy(), atol=1e-12)


def test_the_path_has_the_unit_of_the_depth(frames):
    trained = [frame for frame in frames if frame.seq != 5]
    trained[0] = trained[0].with_fields(depth=depth_of_surface())
    path = camera_path_of(trained, FIRST)
    centre = -path.at(0.5)[:3, :3].T @ path.at(0.5)[:3, 3]
    np.testing.assert_allclose(centre, 5 * np.array(SIDEWAYS), atol=0.02)


def test_a_path_of_many_frames_is_left_to_the_command(frames):
    with pytest.raises(InvalidInput, match="at most 600 frames, not for 601"):
        camera_path_of([frames[0]] * 601, FIRST)
