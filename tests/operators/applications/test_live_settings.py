"""Defaults of a live run by device, and their override by explicit settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from operators.applications.live_settings import LiveSettings
from operators.applications.replay import PIXELS_PER_GAUSSIAN
from operators.frame_clock import ClockSettings


def chosen(device: str, **asked: object) -> ClockSettings:
    return LiveSettings("source", Path("out"), device=device, clock=ClockSettings(**asked)).chosen_clock  # type: ignore[arg-type]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_everything_that_suits_a_device_is_chosen(device: str) -> None:
    clock = chosen(device)
    assert None not in (
        clock.auto_share, clock.auto_most_ms, clock.at_least_steps, clock.fewest_steps, clock.first_at_least_steps,
        clock.catch_up_intervals,
    )  # fmt: skip


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_what_was_asked_for_wins(device: str) -> None:
    asked = {"auto_share": 0.5, "auto_most_ms": 7.0, "at_least_steps": 3, "fewest_steps": 2, "catch_up_intervals": 1.5}
    clock = chosen(device, **asked, first_at_least_steps=9)
    assert {name: getattr(clock, name) for name in asked} == asked
    assert clock.first_at_least_steps == 9


def test_fewer_steps_asked_for_than_usual_hold_for_frames_that_others_wait_behind_as_well() -> None:
    assert chosen("cuda", at_least_steps=2).fewest_steps == 2


def test_a_cpu_keeps_frames_waiting_for_less_long_and_uses_more_of_their_time() -> None:
    cpu, cuda = chosen("cpu"), chosen("cuda")
    assert (cpu.catch_up_intervals or 0) < (cuda.catch_up_intervals or 0)
    assert (cpu.auto_share or 0) > (cuda.auto_share or 0)


def test_a_gpu_limits_the_time_guaranteed_for_training_and_a_cpu_does_not() -> None:
    assert (chosen("cpu").least_most_ms, chosen("cuda").least_most_ms) == (None, 13.0)
    assert (chosen("cpu", least_most_ms=9.0).least_most_ms, chosen("cuda", least_most_ms=9.0).least_most_ms) == (
        9.0,
        9.0,
    )


@pytest.mark.parametrize(
    ("device", "pixels", "gaussians"),
    [
        ("cpu", 10_000, 10_000 // PIXELS_PER_GAUSSIAN), ("cpu", 640 * 512, 12_000), ("cpu", 3840 * 2160, 12_000),
        ("cuda", 10_000, 10_000 // PIXELS_PER_GAUSSIAN), ("cuda", 640 * 512, 45_000), ("cuda", 1280 * 720, 70_892),
        ("cuda", 1920 * 1080, 100_000), ("cpu", 100, 64), ("cuda", 100, 64),
    ],
)  # fmt: skip
def test_large_pictures_get_more_gaussians_on_a_gpu_and_small_ones_fewer_on_both(device, pixels, gaussians) -> None:
    config = LiveSettings("source", Path("out"), device=device).reconstructor_config(pixels)
    assert (config.gaussians, config.max_gaussians) == (gaussians, 2 * gaussians)
