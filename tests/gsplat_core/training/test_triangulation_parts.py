"""Choice of views, reliability of triangulated points and the value of the loss, in closed form; default weights."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.training import initialisation, measured_losses
from gsplat_core.training.losses import LossContext, loss_weights
from gsplat_core.training.measured_losses import (
    Triangulated,
    TriangulationLoss,
    chosen_views,
    consensus_loss,
    triangulate,
    triangulated,
)

CAMERA = Camera(np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]]), 120, 90)


def at(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -x, -y, -z
    return CAMERA.with_pose(pose)


def seen(angle_deg: float, seq: int = 0, shape: tuple[int, int] = (90, 120)):
    """Return an observation from a direction that differs by an angle at a distance of 40."""
    baseline = 2 * 40 * np.tan(np.radians(angle_deg) / 2)
    return SimpleNamespace(
        camera=at(baseline), seq=seq, of_right=False, image=torch.zeros(*shape, 3), mask=torch.ones(shape)
    )


def test_chosen_views_are_1_5_to_15_degrees_apart():
    angles = [1.45, 1.55, 14.9, 15.1, 0.0]
    others = [seen(angle, seq) for seq, angle in enumerate(angles)]
    others.append(seen(5.0, 5, (45, 60)))
    assert [one.seq for one in chosen_views(seen(0.0), others, 40.0)] == [1, 2]
    assert chosen_views(seen(0.0), others, 0.0) == []
    assert [one.seq for one in chosen_views(seen(0.0), others, 20.0)] == [0, 1], "twice the angle at half the distance"


def test_chosen_views_are_eight_evenly_spaced():
    others = [seen(2 + 0.5 * number, number) for number in (5, 3, 8, 1, 0, 14, 9, 2, 12, 4, 6, 7, 13, 11, 10)]
    assert [one.seq for one in chosen_views(seen(0.0), others, 40.0)] == [0, 2, 4, 6, 8, 10, 12, 14]
    assert len(chosen_views(seen(0.0), others[:8], 40.0)) == 8


@pytest.mark.parametrize("off", [0.0, 0.005, 0.02, 0.5])
def test_consensus_loss_value_is_robust_beyond_one_percent(off):
    depth = torch.full((90, 120), 50.0)
    pixels = torch.tensor([[60.0, 45.0], [80.0, 25.0]])
    z = 50.0 / (1 + off)
    points = torch.tensor([[0.0, 0.0, z], [0.2 * z, -0.2 * z, z]])
    squared = (50 - z) ** 2 * np.array([1.0, 1.08]) / z**2 / 0.01**2
    expected = np.mean(squared / (squared + 1) + 0.25 * np.log(1 + squared))
    found = consensus_loss(depth, Triangulated(pixels, points), CAMERA)
    assert float(found) == pytest.approx(expected, rel=1e-3, abs=1e-6)
    depth[20:30] = 0  # the second point is not rendered
    one = squared[0] / (squared[0] + 1) + 0.25 * np.log(1 + squared[0])
    assert float(consensus_loss(depth, Triangulated(pixels, points), CAMERA)) == pytest.approx(one, rel=1e-3, abs=1e-6)
    assert float(consensus_loss(0 * depth, Triangulated(pixels, points), CAMERA)) == 0


def matched(cameras, points: np.ndarray) -> np.ndarray:
    local = np.stack([points @ c.world_to_camera[:3, :3].T + c.world_to_camera[:3, 3] for c in cameras], 1)
    return local[..., :2] / local[..., 2:] * 100 + [60, 45]


@pytest.mark.parametrize(("angle_deg", "reliable"), [(1.45, False), (1.55, True)])
def test_triangulate_requires_views_1_5_degrees_apart(angle_deg, reliable):
    far = 40 * np.tan(np.radians(angle_deg))
    cameras = [at(), at(3.0), at(0.0, far)]
    points, found = triangulate(matched(cameras, np.array([[0.0, 0, 40]])), cameras)
    assert found.tolist() == [reliable]
    np.testing.assert_allclose(points, [[0, 0, 40]], atol=1e-6)


@pytest.mark.parametrize(("off_px", "reliable"), [(1.7, True), (1.8, False)])
def test_triangulate_reliability_requires_reprojection_within_one_pixel(off_px, reliable):
    """Matches are off up and down. The distance of the middle of all views to them is 0.566 of the error."""
    cameras = [at(-3.0), at(-1.0), at(1.0), at(3.0)]
    pixels = matched(cameras, np.array([[0.0, 0, 40]]))
    pixels[0, :, 1] += np.array([1, -1, -1, 1]) * off_px * 0.5
    assert triangulate(pixels, cameras)[1].tolist() == [reliable]


def test_triangulate_of_no_points_and_wrong_camera_count():
    cameras = [at(-3.0), at(0.0), at(3.0)]
    points, found = triangulate(np.zeros((0, 3, 2)), cameras)
    assert points.shape == (0, 3) and found.shape == (0,)
    pixels = matched(cameras, np.array([[0.0, 0, 40]]))
    for wrong, given in ((pixels, cameras[:2]), (pixels[0], cameras), (pixels[:, :0], [])):
        with pytest.raises(InvalidInput, match=f"with a camera for each of V views, got .* and {len(given)} cameras"):
            triangulate(wrong, given)


def test_triangulate_rejects_points_behind_view():
    cameras = [at(), at(4.0), at(0.0, 4.0), at(0.0, 2.0, 60.0)]
    points = np.array([[1.0, 1, 40], [1, 1, 90]])
    _, reliable = triangulate(matched(cameras, points), cameras)
    assert reliable.tolist() == [False, True]
    _, reliable = triangulate(matched(cameras[:3], points), cameras[:3])
    assert reliable.all()


def test_triangulated_samples_every_fourth_pixel(monkeypatch):
    def flow(image, other, mask, of_other):
        return np.full((90, 120, 2), [-5.0 if other[0, 0, 0] < 0.5 else -10.0, 0.0])

    monkeypatch.setattr(measured_losses, "consistent_flow", flow)
    first, second, third = seen(0.0), seen(0.0), seen(0.0)
    second.camera, third.camera = at(2.0), at(4.0)
    third.image = torch.ones(90, 120, 3)
    found = triangulated(first, [second, third])
    assert found is not None and len(found.pixels) == 30 * 22
    assert sorted(set(found.pixels[:, 0].tolist())) == [2.5 + 4 * number for number in range(30)]
    assert sorted(set(found.pixels[:, 1].tolist())) == [2.5 + 4 * number for number in range(22)]
    torch.testing.assert_close(found.points[:, 2], torch.full((660,), 40.0), rtol=1e-3, atol=0)
    assert triangulated(first, [second]) is None


def test_triangulation_loss_caches_512_frames_and_retries_with_more_views(monkeypatch):
    tried = []
    monkeypatch.setattr(measured_losses, "render_depth", lambda scene, camera: torch.full((4, 4), 40.0))
    monkeypatch.setattr(measured_losses, "consensus_loss", lambda depth, target, camera: target)
    monkeypatch.setattr(measured_losses, "check_parallax", lambda observation, others: None)
    answer = lambda observation, others: (
        tried.append(observation.seq) or (None if observation.seq < 0 else observation.seq)
    )
    monkeypatch.setattr(measured_losses, "triangulated", answer)
    loss, scene = TriangulationLoss(), SimpleNamespace(detach=lambda: None)
    frames = [seen(2.0 + 0.01 * number, number) for number in range(513)]
    context = LossContext(frames[:3], None)
    for frame in (frames[0], frames[1], frames[0]):
        assert loss(scene, frame, context) == frame.seq
    assert tried == [0, 1]
    for frame in frames[2:512]:
        loss(scene, frame, context)
    loss(scene, frames[0], context)
    assert len(tried) == 512
    loss(scene, frames[512], context)
    loss(scene, frames[1], context)
    assert len(tried) == 513
    loss(scene, frames[0], context)
    assert tried[-1] == 0, "the oldest is forgotten first"
    none = seen(2.0, -1)
    for count in (3, 3, 4, 4):
        assert loss(scene, none, LossContext(frames[:count], None)) is None
    assert tried.count(-1) == 2
    assert loss(scene, frames[5], LossContext([frames[5], frames[6]], None)) == 5
    assert loss(scene, seen(0.0, 999), LossContext([frames[5]], None)) is None


@pytest.mark.parametrize(
    ("name", "weight"),
    [
        ("flow", 0.05), ("triangulation", 1), ("normal_consistency", 0.1), ("ray_depth", 0.2), ("range", 0.3),
        ("semantics", 1), ("opacity", 0.01), ("scale", 0.01),
    ],
)  # fmt: skip
def test_default_loss_weight_is_named_in_duplicate_loss_error(name, weight):
    assert loss_weights((name,)) == {name: weight}
    with pytest.raises(InvalidSetting, match=f"twice; name it once, as {name}:{weight}$"):
        loss_weights((name, f"{name}:3"))


@pytest.mark.parametrize("sigma_px", [0.8, 1.0, 2.3])
def test_blurred_kernel_reaches_three_standard_deviations(sigma_px):
    picture = torch.zeros(1, 31, 41)
    picture[0, 15, 20] = 1.0
    found = initialisation._blurred(picture, sigma_px)
    assert float(found.sum()) == pytest.approx(1, abs=1e-5)
    reach = int(np.ceil(3 * sigma_px))
    lit = torch.nonzero(found[0])
    assert lit.min(0).values.tolist() == [15 - reach, 20 - reach]
    assert lit.max(0).values.tolist() == [15 + reach, 20 + reach]
    away = np.arange(-3, 4)
    profile = found[0, 15, 17:24] / found[0, 15, 20]
    np.testing.assert_allclose(profile, np.exp(-0.5 * (away / sigma_px) ** 2), rtol=1e-4)
    np.testing.assert_allclose(found[0], found[0].flip(0), atol=1e-7)


def test_triangulate_ignores_match_with_nan_coordinate():
    cameras = [at(), at(3.0), at(-3.0), at(6.0)]
    point = np.array([2.0, 1.0, 40.0])
    pixels = [
        (camera.K @ (camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3])) for camera in cameras
    ]
    matches = np.stack([each[:2] / each[2] for each in pixels])[None].repeat(3, 0)
    matches[1, 3] = np.nan, 5.0
    matches[2, 2:] = [[np.nan, 1.0], [7.0, np.nan]]
    found, reliable = triangulate(matches, cameras)
    np.testing.assert_allclose(found, [point] * 3, atol=1e-6)
    assert reliable.tolist() == [True, True, False]
