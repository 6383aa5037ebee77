"""The bounded map of a live stream: which key frames stay, and how it is moved and scaled."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.poses import live_odometry
from gsplat_core.poses.live_odometry import KeyFrame, LocalMap, position_of, scaled, unprojected
from gsplat_core.scene.cameras import Camera


def key(x, numbers=(), y=0.0):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3], pose[1, 3] = -x, -y
    numbers = np.array(numbers, np.int64)
    return KeyFrame(pose, numbers, np.zeros((len(numbers), 2)), None, np.zeros((len(numbers), 2)))


def known(places):
    made = LocalMap()
    made.add_points(np.arange(len(places)), torch.tensor(places, dtype=torch.float64))
    return made


def test_local_map_drops_nearest_key_frame_beyond_forty():
    made = known([[0.0, 0, 50 + n] for n in range(41)])
    at = [10.0 * n for n in range(41)]
    at[20] = 192.0  # 2 units from another; the first one and the newest are nearer to each other still, but stay
    at[39], at[40] = 371.0, 372.0
    for n, x in enumerate(at[:40]):
        made.add_key(key(x, [n]))
    assert len(made.keys) == 40 and len(made) == 41
    made.add_key(key(at[40], [40]))
    assert len(made.keys) == 40
    gone = set(range(41)) - {int(each.numbers[0]) for each in made.keys}
    assert gone <= {19, 20} and len(gone) == 1
    assert len(made) == 40 and not made.knows(np.array(sorted(gone)))[0]


def test_local_map_keeps_first_key_frame():
    made = LocalMap()
    for n in range(41):
        made.add_key(key([0.0, 0.5][n] if n < 2 else 10.0 * n, []))
    assert made.keys[0].position[0] == 0.0
    assert len(made.keys) == 40 and made.keys[1].position[0] == 20.0


def test_depth_around_is_median_of_five_nearest_points():
    made = known([[0.0, 0, z] for z in (10, 20, 30, 40, 50, 1000)])
    seen = np.array([[0.1 * n, 0.0] for n in range(1, 7)])
    depth = made.depth_around(key(0.0).pose, np.zeros((1, 2)), np.arange(6), seen)
    assert depth.tolist() == [30.0]


def test_brought_back_moves_later_key_frames_proportionally():
    made = known([[0.0, 0, 50], [0.0, 0, 60], [0.0, 0, 70]])
    made.keys = [key(0.0, [0]), key(1.0, [0, 1]), key(2.0, [1, 2])]
    after = torch.eye(4, dtype=torch.float64)
    after[0, 3] = 4.0
    made.brought_back(made.keys[0], after, 4.0)
    # The newest whole, the one between by half: what both show is moved with the first of them.
    np.testing.assert_allclose(made.points(np.arange(3)), [[0, 0, 50], [2, 0, 120], [4, 0, 280]])
    np.testing.assert_allclose([each.position[0] for each in made.keys], [0, 2 * 1 + 2, 4 * 2 + 4])


def test_rescale_scales_map_about_key_frame():
    made = known([[3.0, 0, 50]])
    made.keys = [key(1.0, [0]), key(4.0)]
    made._rescale(made.keys[0], 2.0)
    np.testing.assert_allclose(made.points(np.arange(1)), [[5, 0, 100]])
    np.testing.assert_allclose([each.position[0] for each in made.keys], [1, 7])


@pytest.mark.parametrize(("factor", "is_taken"), [(0.1, False), (0.11, True), (9.9, True), (10.0, False)])
def test_rescale_ignores_factors_beyond_ten(factor, is_taken):
    made = known([[0.0, 0, 50]])
    made.keys = [key(0.0, [0])]
    made._rescale(made.keys[0], factor)
    assert made.points(np.arange(1))[0, 2] == pytest.approx(50 * factor if is_taken else 50)


def test_anchors_are_up_to_five_key_frames_sharing_six_points():
    made = LocalMap()
    shares = [7, 5, 6, 20, 9, 8, 30, 10]
    made.keys = [key(float(n), range(share)) for n, share in enumerate(shares)]
    window = [key(100.0, range(40))]
    made.keys += window
    assert [each.position[0] for each in made._anchors(window)] == [3, 4, 5, 6, 7]
    few = LocalMap()
    few.keys = [*made.keys[:3], *window]
    assert [each.position[0] for each in few._anchors(window)] == [0, 2]


def test_position_of_scaled_and_unprojected_agree():
    pose = key(3.0, y=4.0).pose
    np.testing.assert_allclose(position_of(pose), [3, 4, 0])
    np.testing.assert_allclose(position_of(scaled(pose, 2.0)), [6, 8, 0])
    np.testing.assert_allclose(unprojected(pose, np.array([[0.1, -0.2]]), torch.tensor([50.0]).double()), [[8, -6, 50]])


@pytest.mark.parametrize(("count", "is_adjusted"), [(11, False), (12, True), (30, True)])
def test_local_map_adjusts_from_twelve_shared_points(count, is_adjusted):
    random = np.random.default_rng(0)
    places = random.uniform([-20, -15, 45], [20, 15, 70], (count, 3))
    made = known((places + random.normal(0, 0.5, places.shape)).tolist())
    for x in (0.0, 8.0):
        each = key(x, range(count))
        local = places - [x, 0, 0]
        each.rays = local[:, :2] / local[:, 2:]
        each.picture = SimpleNamespace(camera=SimpleNamespace(K=np.diag([100.0, 100.0, 1.0])))
        made.keys.append(each)
    made.keys[1].pose[0, 3] += 0.3

    def off_px():
        parts = [(made.points(each.numbers) @ each.pose[:3, :3].T + each.pose[:3, 3], each.rays) for each in made.keys]
        return np.mean([np.abs((local[:, :2] / local[:, 2:]).numpy() - rays).mean() * 100 for local, rays in parts])

    first, depth, before = made.keys[0].pose.clone(), made._depth_of(made.keys[0]), off_px()
    made.adjust()
    assert before > 0.3
    assert off_px() < 0.02 if is_adjusted else off_px() == before
    torch.testing.assert_close(made.keys[0].pose, first)
    torch.testing.assert_close(made._depth_of(made.keys[0]), depth)


def test_local_map_does_not_adjust_single_key_frame():
    made = known([[0.0, 0, 50]] * 20)
    made.keys = [key(0.0, range(20))]
    made.adjust()
    assert torch.equal(made.keys[0].pose, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize(("points", "rounds"), [(20, 5), (200, 2), (900, 1)])
def test_local_map_adjust_rounds_by_number_of_sightings(points, rounds, monkeypatch):
    """Each of three key frames sees all points. 1,500 sightings are adjusted once, and no adjustment has more than five rounds."""
    asked = []
    monkeypatch.setattr(live_odometry, "adjusted", lambda bundle, fixed, rounds: asked.append(rounds) or bundle)
    made = known([[0.1 * n, 0, 50.0] for n in range(points)])
    for x in range(3):
        seen = key(float(x), range(points))
        made.add_key(replace(seen, picture=SimpleNamespace(camera=Camera.from_focal(100.0, 64, 48))))
    made.adjust()
    assert asked == [rounds]
