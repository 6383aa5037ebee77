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
def test_clock_defaults_are_set_for_each_device(device: str) -> None:
    clock = chosen(device)
    assert None not in (
        clock.auto_share, clock.auto_most_ms, clock.at_least_steps, clock.fewest_steps, clock.first_at_least_steps,
        clock.catch_up_intervals,
    )  # fmt: skip


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_explicit_clock_settings_override_device_defaults(device: str) -> None:
    asked = {"auto_share": 0.5, "auto_most_ms": 7.0, "at_least_steps": 3, "fewest_steps": 2, "catch_up_intervals": 1.5}
    clock = chosen(device, **asked, first_at_least_steps=9)
    assert {name: getattr(clock, name) for name in asked} == asked
    assert clock.first_at_least_steps == 9


def test_fewest_steps_is_limited_by_requested_at_least_steps() -> None:
    assert chosen("cuda", at_least_steps=2).fewest_steps == 2


def test_cpu_default_has_shorter_queue_and_larger_training_share_than_cuda() -> None:
    cpu, cuda = chosen("cpu"), chosen("cuda")
    assert (cpu.catch_up_intervals or 0) < (cuda.catch_up_intervals or 0)
    assert (cpu.auto_share or 0) > (cuda.auto_share or 0)


def test_least_most_ms_defaults_to_13_on_cuda_and_none_on_cpu() -> None:
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
def test_default_gaussian_count_by_device_and_picture_size(device, pixels, gaussians) -> None:
    config = LiveSettings("source", Path("out"), device=device).reconstructor_config(pixels)
    assert (config.gaussians, config.max_gaussians) == (gaussians, 2 * gaussians)
