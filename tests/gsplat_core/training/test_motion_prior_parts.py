"""Share of a motion that continues, depth by camera motion, and frames that wait for the prior, in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import RAW_COLUMNS
from gsplat_core.training import motion_prior as prior_module
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.motion_prior import (
    Damping,
    DepthFromMotion,
    Following,
    inverse_depths,
    parallax_terms,
    translation_between,
)

FOCAL_PX = 100.0
CENTRE = torch.tensor([60.0, 45.0], dtype=torch.float64)
FIRST = Camera(np.array([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]]), 120, 90)


def camera(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Camera:
    """Return the first camera at another place, turned about its vertical axis."""
    pose = np.eye(4)
    pose[0, 0], pose[0, 2], pose[2, 0], pose[2, 2] = np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)
    pose[:3, 3] = -pose[:3, :3] @ [x, y, z]
    return FIRST.with_pose(pose)


PIXELS = torch.from_numpy(np.random.default_rng(0).uniform([5, 5], [115, 85], (60, 2)))
DEPTHS = torch.from_numpy(np.random.default_rng(1).uniform(40, 60, 60))


def seen_by(after: Camera, depths: torch.Tensor = DEPTHS) -> torch.Tensor:
    """Return the pixels in another camera of points that the first one sees at `PIXELS`, from their positions."""
    at = torch.cat([(PIXELS - CENTRE) / FOCAL_PX, torch.ones(60, 1, dtype=torch.float64)], 1) * depths[:, None]
    pose = torch.tensor(after.world_to_camera)
    local = at @ pose[:3, :3].T + pose[:3, 3]
    return local[:, :2] / local[:, 2:] * FOCAL_PX + CENTRE


def test_damping_share_is_moving_average():
    """Six tenths at first. Each frame takes part by 0.15, with the least-squares share between -0.5 and 1.5."""
    last = torch.tensor([[1.0, 0, 0], [0, 2, 0]])
    damping = Damping()
    torch.testing.assert_close(damping.damped(last), 0.6 * last)
    share = 0.6
    for realised, observed in (([[1.0, 0, 0], [0, 1, 0]], 0.6), ([[9.0, 0, 0], [0, 9, 0]], 1.5), ([[-9.0, 0, 0], [0, -9, 0]], -0.5), ([[1.0, 7, 0], [5, 2, 3]], 1.0)):  # fmt: skip
        damping.learn(last, torch.tensor(realised))
        share += 0.15 * (observed - share)
        torch.testing.assert_close(damping.damped(last), share * last)
    damping.learn(torch.zeros(2, 3), last)
    torch.testing.assert_close(damping.damped(last), share * last)
    for expected, realised in ((1.0, 1.5 * last), (0.0, -0.5 * last)):
        for _ in range(40):
            damping.learn(last, realised)
        torch.testing.assert_close(damping.damped(last), expected * last)


@pytest.mark.parametrize("after", [camera(x=2.0), camera(1.0, -2.0, 3.0), camera(-1.0, 0.5, -2.0, turn=0.1)])
def test_inverse_depths_are_exact_with_information_of_parallax(after):
    target = seen_by(after)
    found, information = inverse_depths(PIXELS, target, FIRST, after)
    torch.testing.assert_close(found, 1 / DEPTHS)
    c, d = parallax_terms(PIXELS, target, FIRST, after)
    torch.testing.assert_close(c / DEPTHS[:, None], d)
    step = 1e-7
    by_inverse = (seen_by(after, 1 / (1 / DEPTHS + step)) - seen_by(after, 1 / (1 / DEPTHS - step))) / (2 * step)
    torch.testing.assert_close(information, (by_inverse * 1.0).square().sum(1), rtol=0.2, atol=0)


def test_translation_between_rotating_cameras_is_zero():
    assert not translation_between(FIRST, camera(turn=0.3)).any()
    assert not translation_between(camera(1.0), camera(1.0 + 0.9e-9)).any()
    moved = translation_between(camera(1.0), camera(1.0 + 2e-9))
    assert moved[0] != 0 and moved[1] == moved[2] == 0
    turned = camera(3.0, 0.0, 4.0, turn=0.3)
    np.testing.assert_allclose(translation_between(FIRST, turned), turned.world_to_camera[:3, 3])


class Step:
    """Scene of points with a given depth, which records how it is corrected."""

    def __init__(self, depths: torch.Tensor, after: Camera, target: torch.Tensor, patch: pytest.MonkeyPatch) -> None:
        self.gaussians = SimpleNamespace(means=torch.zeros(60, 3, dtype=torch.float64))
        self.factors: list[torch.Tensor] = []
        self.taken: list[Camera] = []
        self.inside = torch.ones(60, 1, dtype=torch.bool)
        deltas = torch.zeros(60, RAW_COLUMNS, dtype=torch.float64)
        patch.setattr(prior_module, "motion_of", lambda step: SimpleNamespace(deltas=lambda time_s: deltas))
        self.depths, self.after, self.target = depths, after, target

    def move(self, depth: DepthFromMotion) -> torch.Tensor | None:
        """Return the factor of each point's depth, or None if nothing is changed."""
        before = len(self.factors)
        seen = SimpleNamespace(pixels=PIXELS, depth=self.depths[:, None], inside=self.inside)
        motion = SimpleNamespace(
            before=FIRST, after=self.after, seen_before=lambda points: seen, at=lambda pixels: self.target - PIXELS
        )
        depth.apply(self, motion, 0.0)
        return self.factors[-1] if len(self.factors) > before else None

    def scale_about(self, about: Camera, factor: torch.Tensor) -> None:
        assert about is FIRST
        self.factors.append(factor)

    def take_distance(self, after: Camera) -> None:
        self.taken.append(after)


def test_depth_from_motion_finds_distance_at_first_motion(monkeypatch):
    """A scene at 50 was assumed at 10. Relief is within 15 %, and one pixel of motion has an error of one."""
    after = camera(x=4.0)
    step, depth = Step(torch.full((60,), 10.0).double(), after, seen_by(after), monkeypatch), DepthFromMotion()
    factor = step.move(depth)
    assert factor is not None and step.taken == [after]
    found = 10 * factor
    plane = float((1 / DEPTHS).mean())
    information = (FOCAL_PX * 4.0) ** 2
    gain = information / (information + 1 / (0.15 * plane) ** 2)
    torch.testing.assert_close(1 / found, plane + gain * (1 / DEPTHS - plane), rtol=0.01, atol=0)
    assert step.move(depth) is not None and step.taken == [after], "the distance is found once"


def test_depth_refinement_is_weighted_and_limited_to_factor_1_4(monkeypatch):
    after = camera(x=1.0)
    wrong = DEPTHS * 1.1
    wrong[:5], wrong[5:10] = 500.0, 5.0
    step, depth = Step(wrong, after, seen_by(after), monkeypatch), DepthFromMotion()
    depth._distance_is_known = True
    step.inside[10:15] = False
    factor = step.move(depth)
    assert factor is not None and step.taken == []
    information = FOCAL_PX**2
    known = 1 / wrong
    gain = information / (information + 1 / (0.15 * known) ** 2)
    expected = (known / (known + gain * (1 / DEPTHS - known))).clamp(1 / 1.4, 1.4)
    expected[10:15] = 1
    torch.testing.assert_close(factor, expected)
    assert float(factor[5:10].max()) == 1.4
    # A point that moved against the parallax says nothing of its depth.
    backwards = Step(wrong, after, 2 * PIXELS - seen_by(after), monkeypatch)
    torch.testing.assert_close(backwards.move(depth), torch.ones(60, dtype=torch.float64))


@pytest.mark.parametrize(("baseline", "enough"), [(0.7, False), (0.8, True)])
def test_depth_from_motion_requires_median_parallax_of_1_5_pixels(monkeypatch, baseline, enough):
    """At a distance of 50 it is 1.4 pixels for a baseline of 0.7."""
    after = camera(x=baseline)
    flat = torch.full((60,), 50.0).double()
    step, depth = Step(torch.full((60,), 10.0).double(), after, seen_by(after, flat), monkeypatch), DepthFromMotion()
    factor = step.move(depth)
    assert (factor is not None) == enough == bool(step.taken)
    if factor is not None:
        torch.testing.assert_close(factor, torch.full_like(factor, 5.0), rtol=1e-3, atol=0)


@pytest.mark.parametrize(("across_px", "explains"), [(3.8, True), (4.2, False)])
def test_depth_from_motion_requires_half_of_squared_motion_explained(monkeypatch, across_px, explains):
    """All points move by 4 pixels as one distance explains, and up or down by turns, which none does."""
    after = camera(x=2.0)
    flat = torch.full((60,), 50.0).double()
    target = seen_by(after, flat)
    target[:, 1] += across_px * torch.where(torch.arange(60) % 2 == 0, 1.0, -1.0)
    step = Step(torch.full((60,), 10.0).double(), after, target, monkeypatch)
    assert (step.move(DepthFromMotion()) is not None) == explains


def test_depth_from_motion_is_robust_to_moving_points(monkeypatch):
    after = camera(x=2.0)
    target = seen_by(after, torch.full((60,), 50.0).double())
    target[:10, 0] -= 8.0
    step = Step(torch.full((60,), 10.0).double(), after, target, monkeypatch)
    factor = step.move(DepthFromMotion())
    assert factor is not None and float(factor[10:].median()) == pytest.approx(5.0, rel=0.06)


def test_depth_from_motion_ignores_rotating_camera(monkeypatch):
    after = camera(turn=0.2)
    step, depth = Step(DEPTHS, after, seen_by(after), monkeypatch), DepthFromMotion()
    depth._distance_is_known = True
    assert step.move(depth) is None


class Prior:
    """Prior that records the frames it processes."""

    def __init__(self) -> None:
        self.frames: list[int | str] = []
        self.revealed_px = 3.0

    def observe(self, frame, time_s, camera, step) -> None:
        self.frames.append(frame.seq)

    def forget(self) -> None:
        self.frames.append("forget")


@pytest.mark.parametrize("at_once", [True, False])
def test_following_passes_all_frames_or_two_newest_to_prior(at_once):
    following = Following(ReconstructorConfig(), at_once=at_once)
    prior = following.prior = Prior()
    image = np.zeros((4, 4, 3), np.uint8)
    observe = lambda seq: following.observe(None, Frame(seq, 0, image), SimpleNamespace(time_s=0.0, camera=None), first=seq == 0)  # fmt: skip
    for seq in range(4):
        observe(seq)
    following.skip(None)
    assert prior.frames == ([0, 1, 2, 3] if at_once else ["forget", 2, 3])
    observe(4)
    following.skip(None)
    assert prior.frames[4:] == ([4] if at_once else []) and prior.frames[:2] == ([0, 1] if at_once else ["forget", 2])
    for seq in (5, 6):
        observe(seq)
    following.forget()
    following.skip(None)
    assert prior.frames[3:] == ([3, 4, 5, 6] if at_once else [])
    assert following.has_revealed(3.0) == at_once and not following.has_revealed(3.1)
    following.cover_revealed()
    assert prior.revealed_px == 0
    following.restart()
    assert prior.frames[-1] == "forget"
