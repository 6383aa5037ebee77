"""Windows, decisions and blending of depth before moving tissue, on made-up motions of a few points."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.depth.maps import DepthMap, doubted
from gsplat_core.experimental import breathing_depth
from gsplat_core.experimental.breathing_depth import OTHERWISE, TOO_FEW, TOO_SHORT, MovingTissue, Pull
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import PARALLAX, Frame

FOCAL_PX = 100.0


@pytest.mark.parametrize(("length_s", "count"), [(3.0, 1), (8.0, 1), (8.5, 2), (12.0, 2), (12.5, 3), (20.0, 4)])
def test_breathing_windows_of_8_seconds_overlap_by_half(monkeypatch, length_s, count):
    monkeypatch.setattr(breathing_depth, "seen_by", lambda frame, camera: (frame, camera))
    times = 5 + np.arange(round(length_s * 30) + 1) / 30
    frames = list(range(len(times)))
    windows = breathing_depth._windows(frames, frames, times)
    assert len(windows) == count
    assert windows[0][1][0] == times[0] and windows[-1][1][-1] == times[-1]
    for pictures, seen_s in windows:
        assert seen_s[-1] - seen_s[0] == pytest.approx(min(8.0, length_s), abs=1 / 30 + 1e-6)
        assert len(seen_s) == int(min(8.0, length_s) * 12.5) + 1
        assert [times[frame] for frame, _ in pictures] == seen_s.tolist()
    for (_, first), (_, second) in pairwise(windows):
        assert second[0] - first[0] <= 4 + 1 / 30


def test_breathing_windows_use_all_frames_of_slow_stream(monkeypatch):
    monkeypatch.setattr(breathing_depth, "seen_by", lambda frame, camera: frame)
    ((pictures, _),) = breathing_depth._windows(list(range(11)), list(range(11)), np.arange(11) * 0.5)
    assert pictures == list(range(11))


def decided(monkeypatch, points=100, hz=(0.5,), off_px=1.0, cycles=4.0, error=0.024, motion_error=0.032):
    """Return the decision for a window with this motion, and its key frames. The default errors have a joint magnitude of 0.04."""
    length_s = cycles / (hz[0] if hz else 1)
    times = np.linspace(0, length_s, 41)
    keys = []

    def follow(pictures, times_s, at):
        keys.extend(at)
        rays = np.zeros((41, points, 2))
        return SimpleNamespace(rays=rays, seen=np.ones((41, points), bool), focal_px=FOCAL_PX, times_s=times_s)

    motion = SimpleNamespace(at=lambda times_s: None, error=np.full(points, motion_error))
    found = SimpleNamespace(hz=hz, error=error)
    monkeypatch.setattr(breathing_depth, "follow_grids", follow)
    monkeypatch.setattr(breathing_depth, "found_in", lambda tracks: found)
    monkeypatch.setattr(breathing_depth, "fitted", lambda tracks, frequencies: motion)
    monkeypatch.setattr(breathing_depth, "fitted_undisturbed", lambda tracks, motion: motion)
    monkeypatch.setattr(breathing_depth, "off_px", lambda at, tracks: np.full((41, points, 2), [off_px, 0.0]))
    return breathing_depth._found([None] * 41, times), keys


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"points": 99}, TOO_FEW), ({"hz": ()}, OTHERWISE), ({"off_px": 1.01}, OTHERWISE), ({"cycles": 0.99, "hz": (0.2,)}, TOO_SHORT),
        ({"motion_error": 0.0325}, TOO_SHORT), ({"error": 0.0245}, TOO_SHORT), ({"hz": (4.1,)}, TOO_SHORT),
    ],
)  # fmt: skip
def test_breathing_window_rejected_beyond_limits(monkeypatch, given, said):
    assert decided(monkeypatch, **given)[0] == said


@pytest.mark.parametrize(("given"), [{}, {"cycles": 1.0, "hz": (0.2,)}, {"hz": (4.0,)}])
def test_breathing_window_accepted_at_limits(monkeypatch, given):
    window, _ = decided(monkeypatch, **({"motion_error": 0.0319} | given))
    assert not isinstance(window, str)
    assert window.error == 0.024
    assert window.middle_s == pytest.approx(window.tracks.times_s.mean())
    # What is off in pixels is seen there, less where the motion has it.
    np.testing.assert_allclose(window.off, np.broadcast_to([-1 / FOCAL_PX, 0], (41, 100, 2)))


@pytest.mark.parametrize(("cycles", "count"), [(0.6, 2), (4.0, 8)])
def test_breathing_window_key_frames_every_1_2_seconds_and_two_at_least(monkeypatch, cycles, count):
    _, keys = decided(monkeypatch, cycles=cycles, hz=(0.5,))
    assert len(keys) == count and keys[0] == 0 and keys[-1] == 40


def window_of(start_s=0.0, error=0.0, points=3, off=0.0):
    """Points at rest at 50, seen by a camera at the origin at five times a second apart."""
    times = start_s + np.arange(5.0)
    where = np.array([[-10.0, 0, 50], [0, 5, 50], [10, 0, 50]])[:points]
    return breathing_depth._Window(
        middle_s=start_s + 2.0, error=error, off=np.full((5, points, 2), off),
        motion=SimpleNamespace(at=lambda times_s: np.repeat(where[None], len(times_s), 0), error=np.full(points, 0.01)),
        tracks=SimpleNamespace(
            times_s=times, seen=np.ones((5, points), bool), focal_px=FOCAL_PX,
            rays=np.repeat((where[:, :2] / where[:, 2:])[None], 5, 0), poses=np.repeat(np.eye(4)[None], 5, 0),
        ),
    )  # fmt: skip


@pytest.mark.parametrize(("time_s", "share"), [(2.0, 1.0), (3.0, 0.5), (1.0, 0.5), (4.0, 0.02), (0.0, 0.02)])
def test_breathing_window_share_largest_in_middle(time_s, share):
    assert breathing_depth._share(window_of(), time_s) == pytest.approx(share)


def surface_of(monkeypatch, window, time_s):
    """Arguments of the surface through the points, and its confidence where its error is that of the first point and its support 1."""
    passed = {}

    def through(pixels, depth, error, size):
        passed.update(pixels=pixels, depth=depth, error=error, size=size)
        return np.full(size, 1.0), np.full(size, error[0]), np.ones(size)

    monkeypatch.setattr(breathing_depth, "surface_through", through)
    _, confidence = breathing_depth._surface(window, Camera.from_focal(FOCAL_PX, 32, 24), time_s)
    return passed, confidence


def test_breathing_surface_uses_observed_pixels_and_depth_of_motion(monkeypatch):
    window = window_of()
    window.off[1], window.off[2] = [0.04, 0.0], [0.0, 0.08]
    passed, _ = surface_of(monkeypatch, window, 1.25)
    off = np.array([0.03, 0.02])
    np.testing.assert_allclose(passed["pixels"], (window.tracks.rays[0] + off) * FOCAL_PX + [16, 12])
    np.testing.assert_allclose(passed["depth"], 50)
    # A point that is off across its ray may be off three times as far along it.
    np.testing.assert_allclose(passed["error"], np.hypot(0.01, 3 * np.linalg.norm(off)))
    assert passed["size"] == (24, 32)


def test_breathing_surface_uses_points_seen_by_both_neighbours_in_front(monkeypatch):
    window = window_of()
    window.tracks.seen[2, 0] = False
    assert len(surface_of(monkeypatch, window, 1.5)[0]["depth"]) == 2
    assert len(surface_of(monkeypatch, window, 1.0)[0]["depth"]) == 3
    window.motion.at = lambda times_s: np.array([[[0, 0, 50.0], [0, 0, -50], [0, 0, 50]]])
    assert len(surface_of(monkeypatch, window, 1.0)[0]["depth"]) == 2


@pytest.mark.parametrize(("error", "confidence"), [(0.0, 1 / (1 + 0.25**2)), (np.sqrt(15) * 0.01, 0.5)])
def test_breathing_confidence_half_at_4_percent_error(monkeypatch, error, confidence):
    _, found = surface_of(monkeypatch, window_of(error=error), 2.0)
    np.testing.assert_allclose(found, confidence)


def test_breathing_pull_moves_points_along_line_of_sight_with_uncertainty(monkeypatch):
    window = window_of()
    asked = []

    def pull_of(rays, off, turns, focal_px):
        asked.append(len(rays))
        return Pull(np.array([0.6, 0.0, -0.8]), 0.5)

    monkeypatch.setattr(breathing_depth, "pull_of", pull_of)
    rays, off = np.array([[0.0, 0.0]]), np.array([[0.03, 0.0]])
    nearer, own = breathing_depth._pulled(window, 3, np.eye(4), rays, off)
    # 3 px across, by 0.6 of each unit: 5 units of 0.01 but for the head-on term, 9 / 10 of which are sure; 0.8 of them towards the camera.
    amount = 0.03 * 0.6 / (0.36 + 0.05**2)
    along = -0.8 * amount * 0.9
    assert nearer == pytest.approx([along])
    assert own == pytest.approx([3 * (0.03 - 0.6 * amount) + 0.4 * abs(along)])
    breathing_depth._pulled(window, 0, np.eye(4), rays, off)
    assert asked == [5, 3]


@pytest.mark.parametrize("pull", [None, Pull(np.array([0.6, 0.0, -0.8]), 1.01)])
def test_breathing_without_clear_pull_keeps_points(monkeypatch, pull):
    monkeypatch.setattr(breathing_depth, "pull_of", lambda *given: pull)
    nearer, own = breathing_depth._pulled(window_of(), 2, np.eye(4), np.zeros((1, 2)), np.array([[0.03, 0.04]]))
    assert nearer == [0.0] and own == pytest.approx([0.15])


def tissue(monkeypatch, windows, surfaces, frames):
    found = iter(windows)
    monkeypatch.setattr(breathing_depth, "_windows", lambda *given: [(None, None)] * len(windows))
    monkeypatch.setattr(breathing_depth, "_found", lambda *given: next(found))
    monkeypatch.setattr(
        breathing_depth, "_surface",
        lambda window, camera, time_s: [np.full((24, 32), value) for value in surfaces[window.middle_s]],
    )  # fmt: skip
    return MovingTissue(frames, [Camera.from_focal(FOCAL_PX, 32, 24)] * len(frames))


def test_breathing_windows_blended_by_share_and_confidence(monkeypatch):
    image, mask = np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.uint8)
    mask[:, :8] = 0
    loss_mask = mask[:, ::-1].copy()
    frame = Frame(0, 3_000_000_000, image, mask=mask, loss_mask=loss_mask)
    windows = [window_of(0.0), window_of(2.0)]  # shares at 3 s: 0.5 and 0.5
    found = tissue(monkeypatch, windows, {2.0: (50.0, 0.8), 4.0: (70.0, 0.2)}, [frame]).depth_of(0)
    assert found.depth[0, 0] == pytest.approx((0.801 * 50 + 0.201 * 70) / 1.002)
    assert found.confidence[5, 15] == pytest.approx((0.801 * 0.8 + 0.201 * 0.2) / 1.002)
    assert not found.confidence[:, :8].any() and not found.confidence[:, 24:].any() and not found.metric


@pytest.mark.parametrize(("time_s", "is_known"), [(0.0, True), (4.0, True), (4.1, False)])
def test_breathing_depth_unknown_outside_windows(monkeypatch, time_s, is_known):
    frame = Frame(0, round(time_s * 1e9), np.zeros((24, 32, 3), np.uint8))
    found = tissue(monkeypatch, [window_of(), TOO_SHORT], {2.0: (50.0, 0.8)}, [frame])
    assert found.doubts == (TOO_SHORT,)
    assert found.depth_of(0).doubt == (None if is_known else TOO_SHORT)


@pytest.mark.parametrize(("most_pixels", "looked_at"), [(10**6, [0, 1, 2, 3, 4]), (3 * 48, [0, 2, 4]), (1, [0])])
def test_breathing_depth_frames_spread_over_recording(monkeypatch, most_pixels, looked_at):
    """Pictures have 48 pixels. The third frame is rejected, and its reason is counted."""
    size, asked = (6, 8), []

    class Tissue:
        def __init__(self, frames, cameras):
            pass

        def depth_of(self, number):
            asked.append(number)
            if number == 2:
                return doubted(size, PARALLAX, "it moves")
            return DepthMap(np.full(size, 5.0 + number, np.float32), np.ones(size, np.float32), PARALLAX, metric=False)

    monkeypatch.setattr(breathing_depth, "MovingTissue", Tissue)
    monkeypatch.setattr(breathing_depth, "MOST_PIXELS", most_pixels)
    frames = [Frame(seq, seq, np.zeros((*size, 3), np.uint8)) for seq in range(5)]
    found = breathing_depth.BreathingDepth().of_recording(frames, [Camera.from_focal(8.0, 8, 6)] * 5)
    assert asked == looked_at
    for number, frame in enumerate(found.frames):
        assert (frame.depth is not None) == (number in looked_at and number != 2)
        assert frame.depth is None or frame.depth[0, 0] == 5 + number
    assert found.doubts == ({"it moves": 1} if 2 in looked_at else {})


@pytest.mark.parametrize(("model", "has_depth"), [("pinhole", True), ("fisheye", False)])
def test_breathing_depth_skips_recording_with_depth_or_other_camera(monkeypatch, model, has_depth):
    monkeypatch.setattr(breathing_depth, "MovingTissue", None)
    frames = [Frame(seq, seq, np.zeros((6, 8, 3), np.uint8)) for seq in range(3)]
    if has_depth:
        frames[1] = frames[1].with_fields(depth=np.ones((6, 8), np.float32))
    camera = Camera(np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), 8, 6, model=model)
    found = breathing_depth.BreathingDepth().of_recording(frames, [camera] * 3)
    assert found.frames == frames and not found.doubts and not found.at_rest
