"""The scope's trajectory from pictures alone, against that of a rendered scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.geometry import evaluate_trajectory
from gsplat_core.geometry.tracks import FeatureTracks, Observations, ReferenceTracks
from gsplat_core.io.recordings.synthetic.rendered import RenderedRecording, RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.tissue import Tissue, Tug
from gsplat_core.poses import odometry
from gsplat_core.poses.breathing import BreathingTrajectory
from gsplat_core.poses.odometry import LEAST_SEEN, Trajectory, followed_part, trajectory_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import RELATIVE_DISTANCE, Frame

COUNT = 16


@pytest.fixture(scope="module")
def rigid() -> RenderedRecording:
    """A moving scope before tissue that stands still."""
    moving, at_rest = Tissue.points, Tug((0.0, 0.0), (0.0, 0.0, 0.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Tissue, "points", lambda self, u, v, time_s, tug: moving(self, u, v, 0.0, at_rest))
        return render_recording(RenderSettings(COUNT, 256, 192, fps=10, seed=3, camera="moving"))


@pytest.fixture(scope="module")
def found(rigid: RenderedRecording) -> Trajectory:
    return trajectory_of(rigid, rigid.camera)


def off_share(found: Trajectory, frames: list[Frame]) -> float:
    """The trajectory's error after rotation and scale, as a share of the true trajectory's length."""
    errors = evaluate_trajectory(found.poses, np.stack([frame.pose for frame in frames]))
    assert errors is not None
    return errors.similarity_share


def test_trajectory_of_moving_scope_is_accurate(rigid, found):
    assert off_share(found, list(rigid)) < 0.03
    assert found.error_px < 0.4 < found.still_error_px and found.explained > 0.9
    assert found.lost == () and found.path > 1
    assert np.array_equal(found.poses[0], np.eye(4))


def test_still_error_px_is_spread_of_tracks(rigid, found):
    """In pixels, from the tracked points themselves; by the scope's motion it is many times the reprojection error."""
    tracks = ReferenceTracks()
    for frame in rigid:
        tracks.follow(frame.image, followed_part(frame))
    seen = tracks.observations(LEAST_SEEN)
    middles = np.stack([np.median(seen.pixels[seen.point == number], axis=0) for number in range(seen.point.max() + 1)])
    spread = np.median(np.linalg.norm(seen.pixels - middles[seen.point], axis=1))
    assert found.still_error_px == pytest.approx(spread, rel=0.1)
    assert found.explained == pytest.approx(1 - (found.error_px / found.still_error_px) ** 2)


def test_trajectory_scale_is_relative_distance_of_first_frame(found):
    assert np.median(found.points[:, 2]) == pytest.approx(RELATIVE_DISTANCE, rel=0.1)


def test_trajectory_points_correlate_with_true_depth(rigid, found):
    first = next(iter(rigid))
    K = rigid.camera.K
    pixels = found.points[:, :2] / found.points[:, 2:] * K[0, 0] + K[:2, 2]
    inside = ((pixels > 2) & (pixels < [253, 189])).all(1)
    column, row = pixels[inside].astype(int).T
    true, ours = first.depth[row, column], found.points[inside, 2]
    assert np.corrcoef(true, ours)[0, 1] > 0.8


def test_trajectory_is_deterministic(rigid, found):
    again = trajectory_of(rigid, rigid.camera)
    assert again.poses.tobytes() == found.poses.tobytes() and again.points.tobytes() == found.points.tobytes()


def test_trajectory_lists_blank_frame_as_lost(rigid):
    frames = list(rigid)
    blank = np.full_like(frames[6].image, 90)
    frames[6] = frames[6].with_fields(image=blank)
    found = trajectory_of(frames, rigid.camera)
    assert found.lost == (6,)
    assert np.array_equal(found.poses[6], found.poses[5])
    others = [index for index in range(COUNT) if index != 6]
    whole = replace(found, poses=found.poses[others])
    assert off_share(whole, [frames[index] for index in others]) < 0.03, "points are found again behind it"


@pytest.mark.parametrize("left", [0, 1, 3])
def test_trajectory_continues_after_loss_of_points(left, monkeypatch):
    """From frame 6 on other points are seen, and only `left` of the first ones, too few for a pose."""
    K = np.array([[200.0, 0, 128], [0, 200, 96], [0, 0, 1]])
    points = np.random.default_rng(0).uniform([-0.7, -0.5, 0.8], [0.7, 0.5, 1.2], (120, 3))
    at = np.stack([0.02 * np.arange(12), 0.01 * np.sin(np.arange(12)), np.zeros(12)], 1)
    sightings = [
        (frame, number)
        for frame in range(12)
        for number in (range(60) if frame < 6 else [*range(left), *range(60, 120)])
    ]
    frame, number = np.ascontiguousarray(np.array(sightings).T)
    local = points[number] - at[frame]
    seen = Observations(frame, number, local[:, :2] / local[:, 2:] * 200 + K[:2, 2])
    monkeypatch.setattr(ReferenceTracks, "observations", lambda self, least: seen)
    grey = np.full((192, 256, 3), 128, np.uint8)
    found = trajectory_of([Frame(index, index, grey) for index in range(12)], Camera(K, 256, 192))
    assert found.lost == (6,)
    for part in (slice(0, 6), slice(7, 12)):
        step, true = (np.linalg.norm(np.diff(each[part], axis=0), axis=1) for each in (found.poses[:, :3, 3], at))
        np.testing.assert_allclose(step / true, np.full(len(true), step[0] / true[0]), rtol=0.02)


def test_trajectory_of_four_frames_with_masked_quarters(rigid):
    """Each frame hides another quarter of the picture, so no point is seen in all of them."""
    frames = list(rigid)[:4]
    for index, frame in enumerate(frames):
        mask = np.ones(frame.image.shape[:2], np.uint8)
        np.array_split(np.array_split(mask, 2)[index // 2], 2, axis=1)[index % 2][:] = 0
        frames[index] = frame.with_fields(mask=mask)
    found = trajectory_of(frames, rigid.camera)
    assert found.lost == () and len(found.points) >= 24


def test_feature_tracks_do_not_continue_into_other_scene(rigid):
    frames = list(rigid)[:4] + [Frame(4 + i, 0, textured(9)[:192, :256].copy()) for i in range(20)]
    tracks = FeatureTracks()
    for frame in frames:
        tracks.follow(frame.image, frame.mask)
    seen = tracks.observations(3)
    before, after = (set(seen.point[chosen]) for chosen in (seen.frame < 4, seen.frame >= 4))
    assert before and after and len(before & after) < 0.2 * len(before)


@pytest.mark.parametrize(
    ("count", "model", "said"),
    [
        (2, "pinhole", "at least 3 frames, got 2"),
        (8, "pinhole", "too few recognisable points"),
        (8, "fisheye", "this one is fisheye"),
    ],
)
def test_trajectory_of_refuses_insufficient_input(count, model, said):
    camera = Camera(np.array([[100.0, 0, 40], [0, 100, 32], [0, 0, 1]]), 80, 64, model=model)
    grey = np.full((64, 80, 3), 128, np.uint8)
    with pytest.raises(InvalidInput, match=said):
        trajectory_of([Frame(index, index, grey) for index in range(count)], camera)


def textured(seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return np.kron(random.integers(30, 220, (32, 40, 3)), np.ones((7, 7, 1))).astype(np.uint8)


def test_feature_tracks_follow_shift_and_avoid_tool():
    whole, tracks = textured(), FeatureTracks()
    mask = np.ones((120, 160), np.uint8)
    mask[:, 100:] = 0
    for step in range(5):
        tracks.follow(np.ascontiguousarray(whole[10:130, 20 - 2 * step : 180 - 2 * step]), mask)
    seen = tracks.observations(5)
    assert len(np.unique(seen.point)) > 10
    assert seen.pixels[:, 0].max() < 100
    for point in np.unique(seen.point):
        moved = np.diff(seen.pixels[seen.point == point], axis=0)
        np.testing.assert_allclose(moved, np.tile([2.0, 0.0], (4, 1)), atol=0.2)


def test_observations_point_numbers_are_consecutive():
    tracks = FeatureTracks()
    for _ in range(4):
        tracks.follow(textured()[:120, :160].copy(), None)
    seen = tracks.observations(3)
    assert np.array_equal(np.unique(seen.point), np.arange(seen.point.max() + 1))
    assert (np.diff(seen.frame) >= 0).all() and torch.from_numpy(seen.point).dtype == torch.int64


CAMERA = Camera(np.array([[200.0, 0, 128], [0, 200, 96], [0, 0, 1]]), 256, 192)
GREY = np.full((192, 256, 3), 128, np.uint8)


def exact(count: int, points: int = 60, seed: int = 0) -> Observations:
    """Return exact observations of points by a scope that moves a little from frame to frame."""
    at = np.random.default_rng(seed).uniform([-0.7, -0.5, 0.8], [0.7, 0.5, 1.2], (points, 3))
    frame, number = (each.ravel() for each in np.meshgrid(np.arange(count), np.arange(points), indexing="ij"))
    local = at[number] - np.stack([0.01 * frame, 0.05 * np.sin(frame), 0 * frame], 1)
    return Observations(frame, number, local[:, :2] / local[:, 2:] * 200 + CAMERA.K[:2, 2])


def odometry_of(seen: Observations, count: int) -> odometry._Odometry:
    return odometry._Odometry(seen, CAMERA, [0.1 * number for number in range(count)])


@pytest.mark.parametrize(("count", "apart"), [(10, 1), (60, 1), (61, 2), (300, 5), (600, 10), (601, 10), (1200, 10)])
def test_odometry_key_frame_spacing_by_frame_count(count, apart):
    keys = torch.nonzero(odometry_of(exact(2), count)._is_key)[:, 0].tolist()
    assert keys == sorted({*range(0, count, apart), count - 1})


def test_odometry_adjusts_after_a_third_more_key_frames(monkeypatch):
    adjusted = []
    monkeypatch.setattr(odometry._Odometry, "_adjust", lambda self, last, flat_px: adjusted.append((flat_px, last + 1)))
    odometry_of(exact(40), 40).run(False)
    frames = [3, 4, 6, 8, 11, 15, 20, 27, 36, 40]
    for flat_px in (0.0, odometry.FLAT_PX):
        assert [last for flat, last in adjusted if flat == flat_px] == frames
    assert len(adjusted) == 2 * len(frames)


@pytest.mark.parametrize(("left", "lost"), [(23, (5,)), (24, ())])
def test_odometry_places_frame_from_24_points(monkeypatch, left, lost):
    seen = exact(8)
    some = seen.of((seen.frame != 5) | (seen.point < left))
    monkeypatch.setattr(ReferenceTracks, "observations", lambda self, least: some)
    found = trajectory_of([Frame(index, index, GREY) for index in range(8)], CAMERA)
    assert found.lost == lost and found.error_px < 0.01


def test_odometry_new_point_depth_is_median_of_five_nearest():
    depths = np.array([3.0, 4.0, 5.0, 1.0, 2.0, *[9.0] * 30])
    rays = np.concatenate([np.linspace(0.01, 0.05, 5), np.linspace(0.3, 0.5, 30)])
    pixels = np.stack([200 * np.append(rays, 0.0) + 128, np.full(36, 96.0)], 1)
    state = odometry_of(Observations(np.zeros(36, int), np.arange(36), pixels), 2)
    state._poses[0, 0, 3] = 0.5
    state._known[:35] = True
    state._points[:35] = torch.from_numpy(np.stack([rays * depths - 0.5, 0 * rays, depths], 1))
    state._take_up(0)
    np.testing.assert_allclose(state._points[35], [-0.5, 0.0, 3.0], atol=1e-12)
    assert bool(state._known.all())


@pytest.mark.parametrize(("count", "least"), [(3, 3), (4, 3), (5, 4), (9, 4)])
def test_trajectory_of_minimum_observations_per_point(monkeypatch, count, least):
    asked = []
    seen = exact(count)
    monkeypatch.setattr(ReferenceTracks, "observations", lambda self, least: asked.append(least) or seen)
    trajectory_of([Frame(index, index, GREY) for index in range(count)], CAMERA)
    assert asked == [least]


@pytest.mark.parametrize(("points", "refused"), [(23, True), (24, False)])
def test_trajectory_of_requires_72_observations(monkeypatch, points, refused):
    seen = exact(3, points)
    monkeypatch.setattr(ReferenceTracks, "observations", lambda self, least: seen)
    frames = [Frame(index, index, GREY) for index in range(3)]
    if not refused:
        assert len(trajectory_of(frames, CAMERA).points) == points
        return
    with pytest.raises(InvalidInput, match="only 69 observations of tissue could be tracked over 3 frames"):
        trajectory_of(frames, CAMERA)


def test_trajectory_of_refuses_more_than_3000_frames(monkeypatch):
    monkeypatch.setattr(ReferenceTracks, "follow", lambda self, image, mask: None)
    monkeypatch.setattr(odometry, "followed_part", lambda frame: None)
    frame = Frame(0, 0, GREY)
    with pytest.raises(InvalidInput, match="at most 3000 frames at once"):
        trajectory_of([frame] * 3001, CAMERA)
    with pytest.raises(ValueError, match="concatenate"):  # after all frames are read
        trajectory_of([frame] * 3000, CAMERA)


def test_trajectory_breathing_is_in_trajectory_units(monkeypatch):
    """Breathing is estimated in the first depth as the unit of length, with errors of rays."""
    seen, given = exact(8), []
    monkeypatch.setattr(ReferenceTracks, "observations", lambda self, least: seen)
    poses = torch.eye(4, dtype=torch.float64).repeat(8, 1, 1)
    poses[:, 0, 3] = torch.arange(8) / 100
    points = torch.arange(6, dtype=torch.float64).view(2, 3)

    def separated(sightings, placed):
        given.append((sightings, placed))
        return BreathingTrajectory(poses.clone(), points, (0.3, 1.1), 0.02, 0.004)

    monkeypatch.setattr(odometry, "breathing_trajectory", separated)
    frames = [Frame(index, index * 100_000_000, GREY) for index in range(8)]
    found = trajectory_of(frames, CAMERA)
    assert found.breathing is not None and found.breathing.frequencies_hz == (0.3, 1.1)
    assert found.breathing.uncertain == pytest.approx(0.02 * RELATIVE_DISTANCE)
    assert found.error_px == pytest.approx(0.8)
    np.testing.assert_allclose(found.points, points * RELATIVE_DISTANCE)
    np.testing.assert_allclose(found.poses[:, 0, 3], np.arange(8) / 100 * RELATIVE_DISTANCE)
    ((sightings, placed),) = given
    assert bool(placed.all()) and len(sightings.frame) == len(seen.frame)
    np.testing.assert_allclose(sightings.times_s, np.arange(8) / 10)
    np.testing.assert_allclose(sightings.rays, (seen.pixels - [128, 96]) / 200)
    assert float(sightings.points[:, 2].median()) == pytest.approx(1, abs=0.01)
    monkeypatch.setattr(odometry, "breathing_trajectory", lambda *_: None)
    still = trajectory_of(frames, CAMERA)
    assert still.breathing is None and still.error_px < 0.01
    assert trajectory_of(frames, CAMERA, separate_breathing=False).poses.tobytes() == still.poses.tobytes()


def test_followed_part_excludes_tools_and_outside():
    picture = np.full((24, 32, 3), 90, np.uint8)
    assert followed_part(Frame(0, 0, picture)) is None
    mask, field = np.ones((24, 32), np.uint8), np.ones((24, 32), np.uint8)
    mask[:, :8], field[:6] = 0, 0
    part = followed_part(Frame(0, 0, picture, mask=mask, loss_mask=field))
    expected = np.ones((24, 32), bool)
    expected[:, :8] = expected[:6] = False
    assert np.array_equal(part != 0, expected)


def test_odometry_places_frames_between_key_frames_again_at_end(monkeypatch):
    """Frame 4 is lost at first. All is adjusted with the third key frame, after each 30 % more, and with the last."""
    calls = []
    made = object.__new__(odometry._Odometry)
    made._while_refining = lambda: None
    made._count, made._points, made._known = 13, torch.zeros(1, 3), torch.zeros(1, dtype=torch.bool)
    made._is_key = torch.zeros(13, dtype=torch.bool)
    made._is_key[::2] = True
    monkeypatch.setattr(made, "_take_up", lambda frame: calls.append(("points", frame)))
    monkeypatch.setattr(made, "_place", lambda frame: calls.append(("pose", frame)) or frame != 4)
    monkeypatch.setattr(made, "_adjust", lambda frame, flat_px: calls.append(("all", frame, flat_px)))
    monkeypatch.setattr(made, "_whole", lambda: None)
    monkeypatch.setattr(odometry, "errors_px", lambda bundle: torch.tensor([1.0, 3.0]))
    error = made._follow(5.0)
    assert [call[1] for call in calls if call[0] == "pose"] == [*range(1, 13), 1, 3, 5, 7, 9, 11]
    assert [call[1] for call in calls if call[0] == "points"] == [0, 2, 4, 6, 8, 10, 12]
    assert [call[1:] for call in calls if call[0] == "all"] == [(4, 5.0), (6, 5.0), (10, 5.0), (12, 5.0)]
    assert made._lost == [4] and error == pytest.approx(np.log(2) + np.log(10))
