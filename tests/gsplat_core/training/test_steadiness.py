"""Measure of the regularity of changes between pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.offline import MOST_FRAMES, NOISE_LEVELS, steadiness

WIDTH, HEIGHT = 24, 20
CAMERA = Camera.from_focal(20.0, WIDTH, HEIGHT)


def observations(
    levels: Sequence[float], times: Sequence[float] | None = None, mask: NDArray[np.uint8] | None = None
) -> list[Observation]:
    """Pictures of one grey level each."""
    made = []
    for number, level in enumerate(levels):
        time_s = number / 30 if times is None else times[number]
        image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
        made.append(Observation.of(Frame(number, round(time_s * 1e9), image, mask=mask), CAMERA))
    return made


def test_steadiness_of_still_or_linear_change_is_one() -> None:
    assert steadiness(observations([90] * 5)) == 1
    assert steadiness(observations(range(0, 200, 20))) == 1


def test_steadiness_uses_frame_times() -> None:
    # Four seconds to a frame, one to the next: its level is where the time says.
    assert steadiness(observations([0, 80, 100], [0.0, 4.0, 5.0])) == 1
    assert steadiness(observations([0, 80, 100])) < 0.05
    assert steadiness(observations([0, 80, 100], [1.0, 1.0, 1.0])) < 0.05


@pytest.mark.parametrize("off", [10, 20, 60])
def test_steadiness_falls_with_squared_difference(off: int) -> None:
    levels = [100, 100 + off, 100]
    assert steadiness(observations(levels)) == pytest.approx(1.5 * NOISE_LEVELS**2 / off**2)


def test_steadiness_tolerates_noise() -> None:
    random = np.random.default_rng(0)
    noisy = [
        Frame(n, n * 10**8, np.clip(random.normal(120, NOISE_LEVELS, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8))
        for n in range(20)
    ]
    assert steadiness([Observation.of(frame, CAMERA) for frame in noisy]) > 0.95


def test_steadiness_ignores_masked_pixels() -> None:
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :12] = 0
    made = observations([50] * 4, mask=mask)
    for number, each in enumerate(made):
        each.image[:, :12] = 60 * (number % 2)
    assert steadiness(made) == 1
    hidden = observations([0, 200, 0], mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    assert steadiness(hidden) == 1


def test_steadiness_of_fewer_than_three_frames_is_one() -> None:
    assert steadiness(observations([0])) == 1
    assert steadiness(observations([0, 255])) == 1


def test_steadiness_samples_whole_recording() -> None:
    late = [100] * (5 * MOST_FRAMES) + [100, 200] * (5 * MOST_FRAMES)
    assert steadiness(observations(late)) < 0.05
