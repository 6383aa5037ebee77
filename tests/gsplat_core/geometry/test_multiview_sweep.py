"""Costs of a plane sweep, and depth of corners against given poses, in closed form and by loops."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.depth import multiview
from gsplat_core.depth.maps import DepthMap, doubted
from gsplat_core.depth.multiview import ParallaxDepth, View, explained_by_poses, matching_costs
from gsplat_core.ops.plane_sweep import COST_STEPS
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import PARALLAX, Frame

FOCAL_PX, WIDTH, HEIGHT = 60.0, 64, 48
TISSUE = np.ones((HEIGHT, WIDTH), np.uint8)


def camera(x: float = 0.0, turn: float = 0.0) -> Camera:
    """Return a camera that is moved to the right, and turned to the right."""
    pose = np.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)
    pose[:3, 3] = -pose[:3, :3] @ [x, 0, 0]
    return Camera.from_focal(FOCAL_PX, WIDTH, HEIGHT, pose)


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 200, (HEIGHT, WIDTH), np.uint8)


def sweep(reference: View, others: list[View], inverse_depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Costs from 0 to 0.5, and votes."""
    costs, votes = matching_costs(reference, others, inverse_depths)
    return costs.numpy() / COST_STEPS, votes.numpy()


def test_costs_are_least_at_distance_of_shifted_view():
    """A wall 20 away shifts by 6 pixels for a baseline of 2, and in brighter light."""
    grey = noise()
    reference = View(grey, TISSUE, camera())
    other = View((1.2 * np.roll(grey, -6, 1) + 10).astype(np.uint8), TISSUE, camera(2.0))
    cost, votes = sweep(reference, [other, other], np.array([1 / 30, 1 / 20, 1 / 15]))
    inner = np.s_[4:-4, 11:-4]
    assert cost[inner][..., 1].max() < 0.01 and (votes[inner][..., 1] == 2).all()
    for wrong in (0, 2):
        assert 0.4 < cost[inner][..., wrong].mean() <= 0.5 and cost.max() == 0.5
        assert votes[inner][..., wrong].mean() < 0.1
    assert (cost[4:-4, :6, 1] == 0.5).all() and (votes[4:-4, :6, 1] == 0).all(), "outside the other view"


@pytest.mark.parametrize(("deviation", "cost"), [(2.0, 0.25), (6.0, 0.05), (1.0, 0.4)])
def test_contrast_of_two_grey_levels_has_half_correlation(deviation, cost):
    """Two equal pictures of variance v have the correlation v / (v + 4)."""
    checks = np.float32(100) + np.float32(deviation) * (2 * (np.indices((HEIGHT, WIDTH)).sum(0) % 2) - 1)
    view = View(checks.astype(np.uint8), TISSUE, camera())
    found, votes = sweep(view, [view], np.array([0.05]))
    assert found[8:-8, 8:-8, 0].mean() == pytest.approx(cost, abs=0.003)
    assert (votes[8:-8, 8:-8, 0] == (cost < 0.2)).all()


def test_views_do_not_count_within_three_pixels_of_masked_pixels():
    grey, hidden = noise(), TISSUE.copy()
    hidden[:, :20] = 0
    view, masked = View(grey, TISSUE, camera()), View(grey, hidden, camera())
    for first, second in ((view, masked), (masked, view)):
        cost, votes = sweep(first, [second], np.array([0.05]))
        assert (cost[:, :23, 0] == 0.5).all() and cost[:, 23:, 0].max() < 0.01
        assert np.array_equal(votes[20, :, 0], np.arange(WIDTH) >= 23)
    cost, votes = sweep(view, [masked, View(noise(1), TISSUE, camera())], np.array([0.05]))
    assert cost[:, 25:, 0].mean() == pytest.approx(0.25, abs=0.03), (
        "the mean of the views, of which none costs more than 0.5"
    )
    assert cost[5:-5, 5:18, 0].mean() > 0.4 and votes.max() == 1


CORNERS = np.random.default_rng(1).uniform([6, 6], [WIDTH - 6, HEIGHT - 6], (40, 2)).astype(np.float32)
DEPTHS = np.random.default_rng(2).uniform(17, 23, 40)


def seen_from(other: Camera, depths: np.ndarray = DEPTHS) -> np.ndarray:
    """Return the pixels of the corners at their depths in another camera, the first pixel's centre at 0."""
    rays = (CORNERS + 0.5 - [WIDTH / 2, HEIGHT / 2]) / FOCAL_PX
    local = np.c_[rays, np.ones(40)] * depths[:, None] @ other.world_to_camera[:3, :3].T + other.world_to_camera[:3, 3]
    return (local[:, :2] / local[:, 2:] * FOCAL_PX + [WIDTH / 2, HEIGHT / 2] - 0.5).astype(np.float32)


@pytest.fixture
def explained(monkeypatch):
    """Explain tracks by poses: (camera, pixels, mask of found corners) of each view, in place of pictures."""

    def found(*tracks):
        given = iter(tracks)
        monkeypatch.setattr(multiview, "_corners", lambda view: CORNERS)
        monkeypatch.setattr(multiview, "_followed", lambda reference, view, corners: next(given)[1:])
        views = [View(noise(), TISSUE, each[0]) for each in tracks]
        return explained_by_poses(View(noise(), TISSUE, camera()), views)

    return found


def track(view: Camera, off_px: np.ndarray | float = 0.0, count: int = 40, depths: np.ndarray = DEPTHS):
    return view, seen_from(view, depths) + np.float32(off_px), np.arange(40) < count


RIGHT, LEFT, TURNED = camera(2.0), camera(-1.0), camera(1.5, 0.1)


def test_corner_depth_uses_all_views(explained):
    found = explained(track(RIGHT), track(LEFT), track(TURNED))
    np.testing.assert_allclose(1 / found.inverse_depths, DEPTHS, rtol=0.01)
    assert found.views == (0, 1, 2) and found.own_motion == 0
    assert 1 / found.plane == pytest.approx(20, rel=0.03)
    assert found.parallax_px == pytest.approx(FOCAL_PX * 2 / 20, rel=0.05), "in the view in which it is largest"


def test_view_with_wrong_pose_is_left_out_and_three_of_five_must_agree(explained):
    aside = np.array([0.0, 4.0])
    found = explained(track(RIGHT), track(LEFT, aside), track(TURNED))
    assert found.views == (0, 2)
    np.testing.assert_allclose(1 / found.inverse_depths, DEPTHS, rtol=0.01)
    five = [track(RIGHT), track(LEFT, aside), track(TURNED), track(LEFT, -aside), track(RIGHT)]
    assert explained(*five).views == (0, 2, 4)
    five[4] = track(RIGHT, -aside)
    assert explained(*five) == multiview.CONTRADICTED


@pytest.mark.parametrize(("count", "used"), [(23, (0,)), (24, (0, 1))])
def test_view_needs_two_dozen_tracked_corners(explained, count, used):
    assert explained(track(RIGHT), track(LEFT, count=count)).views == used
    if count == 23:
        assert explained(track(RIGHT, count=23)) == "too few points of the tissue can be tracked"


@pytest.mark.parametrize(("baseline", "enough"), [(0.4, False), (0.6, True)])
def test_parallax_of_one_and_a_half_pixels_is_sufficient(explained, baseline, enough):
    found = explained(track(camera(baseline)))
    assert (found if isinstance(found, str) else "") == (
        "" if enough else "the poses move but the pictures hardly do: there is no parallax to estimate depth from"
    )


@pytest.mark.parametrize(("off_px", "share"), [(0.55, 0.0), (1.0, 0.8 / 6.0), (1.4, 1.265 / 6.0)])
def test_own_motion_is_residual_beyond_pose_errors(explained, off_px, share):
    """Corners move up or down by turns, across the parallax of 6 pixels. 0.6 pixels are errors of poses and tracks."""
    up_and_down = off_px * np.stack([np.zeros(40), np.where(np.arange(40) % 2, 1, -1)], 1)
    found = explained(track(RIGHT, up_and_down))
    assert found.own_motion == pytest.approx(share, rel=0.05, abs=1e-6)


@pytest.mark.parametrize(("off_px", "explains"), [(1.35, True), (1.75, False)])
def test_view_agrees_with_residual_up_to_quarter_of_parallax(explained, off_px, explains):
    up_and_down = off_px * np.stack([np.zeros(40), np.where(np.arange(40) % 2, 1, -1)], 1)
    found = explained(track(RIGHT, up_and_down))
    assert (found != multiview.CONTRADICTED) == explains


@pytest.mark.parametrize("agreeing", [0, 23, 24])
def test_two_dozen_corners_must_agree_however_large_the_parallax(explained, agreeing):
    """A parallax of 24 pixels allows a median residual of 6 pixels, but a corner that is off by 4 pixels has no depth."""
    up_and_down = 4 * np.stack([np.zeros(40), np.where(np.arange(40) % 2, 1, -1)], 1)
    up_and_down[:agreeing] = 0
    found = explained(track(camera(8.0), up_and_down))
    if agreeing < 24:
        assert found == multiview.CONTRADICTED
    else:
        assert len(found.inverse_depths) == 24


@pytest.mark.parametrize(("count", "agreeing", "reason"), [(24, 23, "TOO_FEW"), (24, 13, "CONTRADICTED")])
def test_few_corners_of_which_most_agree_are_too_few(explained, count, agreeing, reason):
    off_px = np.zeros((40, 2))
    off_px[agreeing:] = [0, 4]
    assert explained(track(camera(8.0), off_px, count=count)) == getattr(multiview, reason)


def test_corner_on_moving_object_is_left_out(explained):
    off_px = np.zeros((40, 2))
    off_px[:5] = [0, 3.2]
    off_px[5:8] = [0, 2.8]
    found = explained(track(RIGHT, off_px), track(TURNED, -off_px))
    assert len(found.inverse_depths) == 35


def test_corner_distance_is_within_quarter_to_four_times_plane_distance(explained):
    depths = DEPTHS.copy()
    depths[:2] = 400.0, 2.0
    found = explained(track(RIGHT, depths=depths), track(LEFT, depths=depths))
    relative = found.inverse_depths / found.plane
    assert relative.min() == pytest.approx(0.25, rel=0.3) and relative.max() <= 4.0 + 1e-9


def pose_of(x: float) -> np.ndarray:
    return camera(x).world_to_camera


@pytest.fixture
def compared(monkeypatch):
    """Replace the comparison of pictures: it records the positions of both sides and believes nothing."""
    asked = []

    def depth_of_view(view, others, size):
        asked.append((float(view.camera.position[0]), sorted(float(each.camera.position[0]) for each in others)))
        return DepthMap(np.full(size, 20, np.float32), np.ones(size, np.float32), PARALLAX, metric=False)

    monkeypatch.setattr(multiview, "depth_of_view", depth_of_view)
    return asked


IMAGE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def streamed(estimator: ParallaxDepth, time_s: float, x: float, **fields):
    frame = Frame(0, round(time_s * 1e9), IMAGE, pose=pose_of(x), **fields)
    return estimator.estimate(frame, camera(x))


def test_stream_depth_is_estimated_five_times_per_second(compared):
    estimator = ParallaxDepth()
    for number in range(9):
        streamed(estimator, 0.09 * number, number)
    assert [x for x, _ in compared] == [1, 4, 7]
    assert compared[1][1] == [0, 1, 2, 3] and compared[2][1] == [0, 1, 2, 3, 4, 5, 6]


def test_stream_frames_are_compared_within_three_seconds(compared):
    estimator = ParallaxDepth()
    for number in range(6):
        streamed(estimator, 0.95 * number, number)
    assert compared[-1] == (5, [2, 3, 4])
    streamed(estimator, 0.5, 9)
    assert len(compared) == 5, "time went back"


def test_older_of_two_closest_of_nine_key_frames_is_removed(compared):
    estimator = ParallaxDepth()
    for number, x in enumerate([0, 3, 4, 6, 8, 10, 12, 14, 16]):
        streamed(estimator, 0.1 * number, x)
    streamed(estimator, 1.2, 16.5)
    assert compared[-1] == (16.5, [0, 4, 6, 8, 10, 12, 14, 16])
    streamed(estimator, 1.5, 30)
    assert compared[-1] == (30, [0, 4, 6, 8, 10, 12, 14, 16]), "16.5 is nearer to 16 than any two others"


def test_new_scene_and_frames_without_pose_are_not_compared(compared):
    estimator = ParallaxDepth()
    streamed(estimator, 0.0, 0.0)
    streamed(estimator, 0.3, 1.0, new_scene="cut")
    assert compared == []
    frame = Frame(0, 600_000_000, IMAGE)
    assert estimator.estimate(frame, camera(2.0)) is None and compared == []
    streamed(estimator, 0.9, 1.0)
    assert compared == [], "the scope has not moved"
    streamed(estimator, 1.2, 2.0)
    assert compared == [(2.0, [1.0])]


def recording(count: int, apart_s: float) -> tuple[list[Frame], list[Camera]]:
    frames = [Frame(number, round(number * apart_s * 1e9), IMAGE, pose=pose_of(number)) for number in range(count)]
    return frames, [camera(number) for number in range(count)]


@pytest.mark.parametrize(("count", "estimated"), [(5, 5), (32, 32), (63, 32)])
def test_recording_depth_of_at_most_32_frames_uses_frames_within_three_seconds(compared, monkeypatch, count, estimated):
    monkeypatch.setattr(multiview, "agree", lambda first, second: True)
    found = ParallaxDepth().of_recording(*recording(count, 0.7))
    numbers = [frame.seq for frame in found.frames if frame.depth is not None]
    assert len(numbers) == estimated == len(compared) and numbers[0] == 0 and numbers[-1] == count - 1
    assert np.ptp(np.diff(numbers)) <= 1 and found.at_rest and not found.doubts
    for x, others in compared:
        assert others == [other for other in range(count) if other != x and abs(other - x) <= 4]


def test_recording_of_still_scope_or_with_depth_stays_unchanged(compared):
    frames, cameras = recording(4, 0.1)
    assert ParallaxDepth().of_recording(frames, [cameras[0]] * 4).frames == frames
    frames[1] = frames[1].with_fields(depth=np.ones((HEIGHT, WIDTH), np.float32))
    assert ParallaxDepth().of_recording(frames, cameras).frames == frames and compared == []


@pytest.mark.parametrize(("agreeing", "kept"), [(2, True), (1, False)])
def test_recording_depth_is_kept_if_half_is_confirmed(compared, monkeypatch, agreeing, kept):
    """Five frames have depth. The first agreement of two frames confirms both, each later one confirms one more."""
    answers = iter([True] * (agreeing == 2) + [False, True] + [False] * 4)
    monkeypatch.setattr(multiview, "agree", lambda first, second: next(answers))
    found = ParallaxDepth().of_recording(*recording(5, 0.1))
    assert sum(frame.depth is not None for frame in found.frames) == (5 if kept else 0)
    assert found.doubts == ({} if kept else {multiview.UNCONFIRMED: 5})


def test_reasons_for_frames_without_depth_are_counted(monkeypatch):
    def depth_of_view(view, others, size):
        x = view.camera.position[0]
        if x < 2:
            return doubted(size, PARALLAX, "too dark")
        return DepthMap(np.full(size, 20, np.float32), np.full(size, x > 2, np.float32), PARALLAX, metric=False)

    monkeypatch.setattr(multiview, "depth_of_view", depth_of_view)
    monkeypatch.setattr(multiview, "agree", lambda first, second: True)
    found = ParallaxDepth().of_recording(*recording(5, 0.1))
    assert [frame.depth is not None for frame in found.frames] == [False, False, True, True, True]
    assert found.doubts == {"too dark": 2, multiview.DEFORMS: 1}
