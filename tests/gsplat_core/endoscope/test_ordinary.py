"""`OrdinaryPictures`: a fast check that never accepts a picture that the full check rejects."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope import sequence
from gsplat_core.endoscope.sequence import OrdinaryPictures

FRAME_NS = 33_000_000


@pytest.fixture
def stream(rng):
    """Return pictures of a textured surface that moves slowly and uniformly."""
    patches = cv2.resize(
        rng.uniform(40, 200, (12, 16, 3)).astype(np.float32), (320, 256), interpolation=cv2.INTER_CUBIC
    )
    noisy = [np.roll(patches, 2 * k, axis=1) + rng.normal(0, 2, patches.shape) for k in range(60)]
    return [np.clip(picture, 0, 255).astype(np.uint8) for picture in noisy]


def judged(pictures, frame_ns=FRAME_NS, **constants):
    with pytest.MonkeyPatch.context() as patch:
        for name, value in constants.items():
            patch.setattr(sequence, name, value)
        follower = OrdinaryPictures()
        return [follower.is_ordinary(picture, k * frame_ns) for k, picture in enumerate(pictures)]


def test_is_ordinary_accepts_most_images_of_uniform_stream(stream):
    found = judged(stream)[10:]
    assert sum(found) > 0.8 * len(found)


def test_is_ordinary_accepts_drift_slower_than_reference_renewal(stream):
    dimmed = [np.clip(picture * (1 - 0.001 * k), 0, 255).astype(np.uint8) for k, picture in enumerate(stream)]
    wide = {"MOST_CHANGE_RATIO": 50.0, "LEAST_CHANGE_RATIO": 0.01}
    renewed, kept = (judged(dimmed, CHECK_EVERY_S=every_s, **wide)[10:] for every_s in (0.2, 30.0))
    assert all(renewed) and not all(kept)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault",
    [
        lambda now, before, rng: np.zeros_like(now),
        lambda now, before, rng: before.copy(),
        lambda now, before, rng: np.concatenate([now[:128], before[128:]]),
        lambda now, before, rng: cv2.GaussianBlur(now, (0, 0), 3),
        lambda now, before, rng: rng.integers(0, 256, now.shape, np.uint8),
        lambda now, before, rng: np.clip(now * 1.2, 0, 255).astype(np.uint8),
        lambda now, before, rng: now[::-1].copy(),
        lambda now, before, rng: now[:200, :200].copy(),
    ],
    ids=["black", "duplicate", "torn", "blurred", "noise", "brighter", "another picture", "another size"],
)
def test_is_ordinary_rejects_faulty_image(stream, rng, fault):
    for at in range(20, 50, 3):
        pictures = list(stream)
        pictures[at] = fault(stream[at], stream[at - 1], rng)
        assert not judged(pictures)[at]


def test_is_ordinary_rejects_slow_change_before_large(stream):
    dimmed = [np.clip(picture * (1 - 0.004 * k), 0, 255).astype(np.uint8) for k, picture in enumerate(stream)]
    assert judged(dimmed, CHECK_EVERY_S=30.0).count(False) > 5


def test_is_ordinary_rejects_time_gap_and_step_back(stream):
    for jump_ns in (10 * FRAME_NS, -5 * FRAME_NS):
        follower = OrdinaryPictures()
        times = [k * FRAME_NS + (jump_ns if k >= 30 else 0) for k in range(40)]
        found = [follower.is_ordinary(stream[k], at) for k, at in enumerate(times)]
        assert not found[30]


@pytest.mark.parametrize("size", [(1, 1), (1, 50), (50, 1), (3, 2), (700, 9)])
def test_is_ordinary_accepts_images_of_any_size(rng, size):
    follower = OrdinaryPictures()
    for k in range(5):
        follower.is_ordinary(rng.integers(0, 256, (*size, 3), np.uint8), k * FRAME_NS)


def test_is_ordinary_renews_reference_every_0_2_seconds(monkeypatch):
    """Ordinary frames are compared with a reference that is renewed after 0.2 s and not before."""
    watch, colours = OrdinaryPictures(), iter(range(1000))
    small = np.zeros((32, 32, 3), np.uint8)
    noisy = [np.full_like(small, level) for level in (100, 103)]
    count = iter(range(1000))
    monkeypatch.setattr(
        sequence, "_sampled", lambda image: (noisy[next(count) % 2], np.full(3, 100 + 0.001 * next(colours)), 5.0)
    )
    looked = []
    for k in range(40):
        watch.is_ordinary(small, k * 40_000_000)
        looked.append(watch._referenced_ns)
    renewed = sorted(set(looked))
    assert {b - a for a, b in zip(renewed[-4:], renewed[-3:], strict=False)} == {200_000_000}
