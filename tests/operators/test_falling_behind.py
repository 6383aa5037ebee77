"""A model that falls behind the stream is detected, displayed as such, and restarted within five frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from operators.frame_clock import RENEW_AFTER, BehindGuard

WIDTH, HEIGHT = 64, 48
LARGE = cv2.resize(
    np.random.default_rng(3).uniform(30, 225, (40, 120, 3)).astype(np.float32),
    (960, 320),
    interpolation=cv2.INTER_CUBIC,
)


def view(x, y=0.0):
    """Return the picture at a position of a scope that moves over a large texture."""
    moved = cv2.warpAffine(LARGE, np.float32([[1, 0, -x], [0, 1, -y]]), (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def frame_at(seq, x=None, **fields):
    return Frame(seq, seq * 33_333_333, view(seq if x is None else x), **fields)


def blurred(image, sigma):
    return cv2.GaussianBlur(image, (0, 0), sigma)


@pytest.fixture
def guard():
    """Guard of a scene whose first picture was good, before frame 1 of a slow scope."""
    made = BehindGuard()
    made.scene_begun(0)
    first = frame_at(0)
    assert not made.judge(first, blurred(first.image, 0.6))
    return made


def test_guard_judges_picture_worse_than_previous_frame_as_behind(guard):
    frames = [frame_at(seq, 0.2 * seq) for seq in range(1, 5)]
    assert not guard.judge(frames[0], blurred(frames[0].image, 0.6))
    assert guard.judge(frames[1], view(5)) and not guard.renewal_is_due()
    assert guard.judge(frames[2], view(5)) and guard.renewal_is_due()
    guard.scene_begun(4)
    assert not guard.renewal_is_due()
    assert not guard.judge(frames[3], frames[3].image)


def test_good_picture_between_bad_ones_defers_renewal(guard):
    for seq in range(1, 9):
        frame = frame_at(seq, 0.2 * seq)
        guard.judge(frame, view(5) if seq % RENEW_AFTER else frame.image)
        assert not guard.renewal_is_due()


@pytest.mark.parametrize("case", ["still", "jump", "withheld", "no tissue", "other scene", "other size"])
def test_guard_does_not_judge_incomparable_frames_as_behind(guard, case):
    """On a still picture the previous frame is perfect. A jump makes it useless."""
    for seq in range(1, 5):
        frame = frame_at(seq, 0.0)
        shown = blurred(frame.image, 0.6)
        if case == "jump":
            frame, shown = frame_at(seq, 40 * seq), view(40 * seq + 2)
        elif case == "withheld":
            frame, shown = frame_at(seq, withheld="blur"), view(9)
        elif case == "no tissue":
            frame, shown = frame_at(seq, 0.0, mask=np.zeros((HEIGHT, WIDTH), np.uint8)), view(9)
        elif case == "other scene":
            frame, shown = frame_at(seq, 0.0, scene=seq), view(9)
        elif case == "other size":
            large = cv2.resize(frame.image, (WIDTH + 4 * seq, HEIGHT))
            frame, shown = Frame(seq, seq, large), blurred(large, 5)
        assert not guard.judge(frame, shown)
    assert not guard.renewal_is_due()


def test_interval_between_useless_renewals_doubles():
    guard, renewed, previous = BehindGuard(), [], 0
    guard.scene_begun(0)
    for seq in range(100):
        frame = frame_at(seq, 0.0)
        if guard.renewal_is_due():
            guard.scene_begun(seq, anew=True)
            renewed.append(seq - previous)
            previous = seq
        first = previous == seq
        guard.judge(frame, frame.image if first else view(5))
    assert renewed == [3, 5, 9, 17, 33]


def test_guard_compares_only_tissue_pixels(guard):
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :30] = 0
    for seq in (1, 2, 3):
        frame = frame_at(seq, 0.0, loss_mask=mask) if seq > 1 else frame_at(seq, 0.0, mask=mask)
        shown = frame.image.copy()
        shown[:, :30] = 0
        assert not guard.judge(frame, shown)


class Stream:
    """Live training with fixed steps and without a clock, guarded as in a live run."""

    def __init__(self, steps, guarded=True, **live):
        self.steps, self.guarded, self.guard, self.renewed = steps, guarded, BehindGuard(), []
        config = ReconstructorConfig(
            gaussians=WIDTH * HEIGHT // 6, max_gaussians=WIDTH * HEIGHT // 3, window_frames=20, motion_spacing_s=0.1,
            history_s=1.0, preallocate=True, motion_prior="flow",
        )  # fmt: skip
        self.made = Reconstructor(config, Camera.from_focal(60.0, WIDTH, HEIGHT), live=LiveTraining(**live))
        self._previous = None

    def __call__(self, frame):
        """Return the PSNR of the shown picture minus that of the previous frame."""
        made, before = self.made, self._previous
        anew = self.guarded and self.guard.renewal_is_due()
        first = anew or before is None or frame.scene != before.scene
        if first and before is not None:
            made.begin_scene(frame, anew=anew)
        if first:
            self.guard.scene_begun(frame.seq, anew=anew)
        self.renewed += [frame.seq] if anew else []
        made.observe(frame, budget=Budget.of_steps(8 if first else self.steps))
        shown = made.publish().render(frame.time_s).image
        image = (shown.clamp(0, 1) * 255).round().byte().numpy()
        if not first:
            made.grow(frame)
        self.guard.judge(frame, image)
        self._previous = frame
        return psnr_tissue_db(image, frame.image) - psnr_tissue_db((before or frame).image, frame.image)


def journey(*speeds):
    """Yield noisy frames of a scope that rests, moves at these speeds in pixels a frame, sees smoke and is cut to
    another view."""
    x, seq, noise = 20.0, 0, np.random.default_rng(5)

    def taken(image, scene=0):
        nonlocal seq
        noisy = np.clip(np.rint(image + noise.normal(0, 6, image.shape)), 0, 255).astype(np.uint8)
        seq += 1
        return Frame(seq, seq * 33_333_333, noisy, scene=scene)

    for speed in [0.0] * 4 + list(speeds) + [0.0] * 6:
        x += speed
        yield taken(view(x))
    for smoke in (0.1, 0.3, 0.2, 0.0):
        yield taken(view(x) * (1 - smoke) + 200 * smoke)
    for number in range(4):
        yield taken(view(500.0 + number), scene=1)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [4, 12])
def test_moving_scope_picture_is_at_most_1_db_below_previous_frame(steps):
    stream = Stream(steps, colour_relaxation=1.5)
    gains = [stream(frame) for frame in journey(*[5.0] * 6)]
    assert min(gains[1:]) > -1.0 and not stream.renewed


def test_guard_renewal_restores_model_within_five_frames():
    """The learning rates are far too small for the motion, so only a new scene can show later frames."""
    frames = list(journey(3.0, 3.0, 3.0))[:13]
    slow = dict(first_rate=0.01, last_rate=0.01)
    lost, guarded = Stream(1, guarded=False, **slow), Stream(1, **slow)
    left = [lost(frame) for frame in frames]
    kept = [guarded(frame) for frame in frames]
    at_rest = min(left[1:4])
    assert max(left[7:]) < at_rest - 5
    assert len(guarded.renewed) == 1 and min(kept[7:]) > at_rest - 1
