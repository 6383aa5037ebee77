"""Times that a scope path keeps, and interpolation of positions between them."""

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.scope_path import MOST_TIMES, ScopePath


def pose_at(centre):
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(centre, float)
    return pose


def test_a_scope_at_rest_has_one_pose_for_all_times():
    path = ScopePath.of(np.arange(100) / 10, [pose_at((1, 2, 3))] * 100)
    assert len(path.times_s) == MOST_TIMES and path.world_to_camera.shape == (1, 4, 4)
    assert (path.times_s[0], path.times_s[-1]) == (0.0, 9.9)
    assert path.centre_at(4.2).tolist() == [1, 2, 3] and path.pose(17).tolist() == pose_at((1, 2, 3)).tolist()


def test_a_moving_scope_is_on_straight_lines_between_what_is_kept_and_stays_at_the_ends():
    path = ScopePath.of([0.0, 1.0, 2.0], [pose_at((0, 0, 0)), pose_at((2, 0, 0)), pose_at((2, 4, 0))])
    assert path.centre_at(0.5).tolist() == [1, 0, 0]
    assert path.centre_at(1.25).tolist() == [2, 1, 0]
    assert path.centre_at(-5).tolist() == [0, 0, 0] and path.centre_at(9).tolist() == [2, 4, 0]


def test_the_centre_is_that_of_a_turned_camera():
    turn = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    path = ScopePath((0.0,), turn[None])
    np.testing.assert_allclose(turn @ [*path.centre_at(0.0), 1], [0, 0, 0, 1], atol=1e-12)


def test_of_frames_of_one_time_the_last_one_counts():
    path = ScopePath.of([0.0, 0.0, 1.0], [pose_at((9, 9, 9)), pose_at((1, 0, 0)), pose_at((2, 0, 0))])
    assert path.times_s == (0.0, 1.0) and path.centre_at(0.0).tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    ("times", "poses"),
    [
        ((), np.zeros((0, 4, 4))),
        ((1.0, 1.0), np.stack([np.eye(4)] * 2)),
        ((0.0, float("nan")), np.stack([np.eye(4)] * 2)),
        ((0.0, 1.0, 2.0), np.stack([np.eye(4)] * 2)),
        ((0.0,), np.full((1, 4, 4), np.inf)),
        (tuple(range(MOST_TIMES + 1)), np.eye(4)[None]),
    ],
)
def test_what_is_no_path_is_refused(times, poses):
    with pytest.raises(InvalidInput, match="path"):
        ScopePath(times, poses)
