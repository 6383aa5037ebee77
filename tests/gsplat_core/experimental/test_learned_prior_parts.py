"""Parts of the prior that learns: remembered moments, the mixture of pictures, and units of motion, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.experimental import learned_prior
from gsplat_core.experimental.learned_prior import ExpectedPicture, LearnedPrior, SimilarMoments, weighted_mean
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import CELL_PX
from tests.gsplat_core.training.test_motion_prior import stream

SHAPE = (12, 16, 2)


def constant(value: float) -> np.ndarray:
    return np.full(SHAPE, value, np.float32)


def after(*values: float) -> list[tuple[float, float]]:
    """Return weights and values of the motions that are expected after some motions."""
    moments = SimilarMoments()
    for value in values:
        moments.take(constant(value))
    return [(weight, float(motion.mean())) for weight, motion in moments.next_motions()]


def test_expected_motions_follow_six_similar_moments():
    assert len(after(*[float(number % 5) for number in range(60)])) == 6


def test_moment_weights_decay_exponentially_with_relative_difference():
    """Two pairs of motions before: one off by 1 and then 1, the other by 2 and then 1, each with a weight of 0.64."""
    rest = [50.0, -50.0] * 4
    values = [*rest, 11.0, 21.0, 7.0, *rest, 12.0, 21.0, 8.0, *rest, 10.0, 20.0]
    found = {round(value): weight for weight, value in after(*values) if value in (7.0, 8.0)}
    near, far = 1 + 0.64 * 1, 1 + 0.64 * 4
    assert found[8] / found[7] == pytest.approx(np.exp(1 - far / near), rel=0.02)


def test_moments_limited_to_last_255_frames():
    values = [9.0, 5.0, *[0.0] * 252]
    assert any(value == 5.0 for _, value in after(*values, 9.0))
    assert not any(value == 5.0 for _, value in after(*values, 0.0, 9.0))


def test_expected_picture_averages_with_fifth_of_newest_and_clips(monkeypatch):
    still = np.zeros((48 // CELL_PX, 64 // CELL_PX, 2), np.float32)
    picture = ExpectedPicture()
    levels = [100, 200, 50, 250]
    for level in levels:
        picture.take(np.full((48, 64, 3), level, np.uint8), None, still)
        picture.after(still)
    mean = 100.0
    for level in levels[1:]:
        mean = 0.8 * mean + 0.2 * level
    assert picture._guesses is not None
    np.testing.assert_allclose(picture._guesses.others[1], mean - 250, atol=0.01)
    monkeypatch.setattr(picture._shares, "local", lambda shape: np.array([0.0, -1.0, 0, 0], np.float32) * np.ones((*shape[:2], 4), np.float32))  # fmt: skip
    np.testing.assert_array_equal(picture.after(still), 255.0)


def test_expected_picture_guesses_unmoved_blurred_and_mean():
    """Expected blur: a line of one pixel has its Gaussian profile of a standard deviation of 1.5 pixels."""
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 30] = 240
    right = np.full((48 // CELL_PX, 64 // CELL_PX, 2), [4.0, 0.0], np.float32)
    picture = ExpectedPicture()
    picture.take(image, None, None)
    picture.after(right, [(0.25, 0 * right), (0.75, -right)])
    assert picture._guesses is not None
    newest = picture._guesses.moved
    unmoved, mean, blurred, spread = (guess + newest for guess in picture._guesses.others)
    assert newest[20, 34, 0] == 240 and unmoved[20, 30, 0] == mean[20, 34, 0] == 240
    profile = np.exp(-0.5 * (np.arange(-4, 5) / 1.5) ** 2)
    np.testing.assert_allclose(blurred[20, 30:39, 0], 240 * profile / (1.5 * np.sqrt(2 * np.pi)), atol=1.5)
    assert spread[20, [26, 30, 34], 0].tolist() == [180, 60, 0]


def test_expected_picture_learns_from_tissue_only(monkeypatch):
    picture, weights = ExpectedPicture(), []
    still, mask = np.zeros((48 // CELL_PX, 64 // CELL_PX, 2), np.float32), np.ones((48, 64), np.uint8)
    mask[:, :20] = 0
    monkeypatch.setattr(picture._shares, "learn", lambda guesses, came, weight: weights.append((came, weight)))
    for level in (100, 130, 150):
        picture.take(np.full((48, 64, 3), level, np.uint8), mask, still)
        picture.after(still)
    assert len(weights) == 2
    for (came, weight), change in zip(weights, (30, 20), strict=True):
        assert (came == change).all() and np.array_equal(weight, mask)


def prior_of(interval_s: float) -> LearnedPrior:
    prior = LearnedPrior(ReconstructorConfig(motion_prior="learned"))
    prior._interval_s = interval_s
    return prior


@pytest.mark.parametrize("interval_s", [1 / 30, 1 / 15])
def test_next_motion_learned_in_units_of_thirtieth_second(interval_s):
    """Six tenths of a motion are expected at first. Then its share is that of ridge regression, locally and as a whole."""
    prior, scale = prior_of(interval_s), interval_s * 30
    flow = np.zeros((10, 12, 2), np.float32)
    flow[..., 0] = 2.0 * scale
    ahead, similar = prior._next_motion(flow, [])
    np.testing.assert_allclose(ahead, 0.6 * flow, rtol=1e-5)
    assert similar == [] and not prior._guesses[1].any()
    np.testing.assert_allclose(prior._guesses[0], flow / scale, rtol=1e-5)
    ahead, _ = prior._next_motion(flow, prior._guesses)
    square = (2.0**2 + 0) / 2  # the mean over both directions
    whole = (square + 0.2 * 0.6) / (square + 0.2)
    share = (square + 4 * whole) / (square + 4)
    np.testing.assert_allclose(ahead, share * flow, rtol=1e-4)
    ahead, _ = prior._next_motion(0 * flow, prior._guesses)
    assert not ahead.any()
    ahead, _ = prior._next_motion(flow, [flow / scale, 0 * flow])
    square, came = square * (1 + 0.97 + 0.97**2), square * (1 + 0.97**2)
    whole = (came + 0.2 * 0.6) / (square + 0.2)
    np.testing.assert_allclose(ahead, (came + 4 * whole) / (square + 4) * flow, rtol=1e-3)


def test_next_motion_of_similar_moments_in_units_of_frame():
    prior = prior_of(1 / 15)
    flow = np.full((10, 12, 2), 3.0, np.float32)
    for _ in range(9):
        _, similar = prior._next_motion(flow, [])
    assert similar and weighted_mean(similar) == pytest.approx(flow, rel=1e-3)
    assert prior._guesses[1] == pytest.approx(flow / 2, rel=1e-3)


def test_learned_prior_horizon_is_one_interval_up_to_150_ms():
    prior = prior_of(0.04)
    assert prior.horizon_s == 0.15
    prior._expected = SimpleNamespace()
    assert prior.horizon_s == 0.04
    prior._interval_s = 0.4
    assert prior.horizon_s == 0.15


def test_learned_prior_velocity_is_motion_and_colour_per_second(monkeypatch):
    """Colours are fitted to the expected picture where its tissue will be."""
    prior, asked = prior_of(0.04), []
    ahead = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.5, 0.0]])
    prior._expected = SimpleNamespace(
        motion=SimpleNamespace(ahead=lambda means: ahead, after="camera"), picture="picture", tissue="tissue"
    )

    def colour_change(gaussians, camera, picture, tissue, steps):
        asked.append((gaussians.means.tolist(), camera, picture, tissue, steps))
        return torch.full((2, 3), 0.2)

    @dataclass
    class Gaussians:
        means: torch.Tensor

    monkeypatch.setattr(learned_prior, "colour_change", colour_change)
    monkeypatch.setattr(LearnedPrior, "_usable_motion", lambda self: "motion")
    means = torch.tensor([[1.0, 1.0, 40.0], [2.0, 2.0, 50.0]])
    velocity = prior.velocity(SimpleNamespace(at=lambda time_s: Gaussians(means)))
    assert velocity is not None
    assert asked == [((means + ahead).tolist(), "camera", "picture", "tissue", 16)]
    torch.testing.assert_close(velocity[:, learned_prior.POSITION], ahead / 0.04)
    torch.testing.assert_close(velocity[:, learned_prior.COLOUR], torch.full((2, 3), 5.0))
    assert int((velocity != 0).sum()) == 4 + 6


def test_learned_prior_expected_image_scaled_to_1_and_weighted_by_tissue(monkeypatch):
    prior = prior_of(1 / 30)
    frame = next(iter(stream([0.0])))
    height, width = frame.image.shape[:2]
    mask = np.ones((height, width), np.uint8)
    mask[:8] = 0
    camera = object()
    motion = SimpleNamespace(before=camera, after=camera)
    monkeypatch.setattr(LearnedPrior, "_usable_motion", lambda self: motion)
    monkeypatch.setattr(learned_prior, "SurfaceMotion", lambda flow, before, after: (flow, before, after))
    flow = np.zeros((height // CELL_PX, width // CELL_PX, 2), np.float32)
    for given in (mask, None):
        prior._take(frame.with_fields(mask=given), flow, torch.device("cpu"))
        expected = prior._expected
        assert expected is not None
        np.testing.assert_allclose(expected.picture.numpy(), frame.image / 255, atol=2e-3)
        assert np.array_equal(expected.tissue.numpy(), np.ones_like(mask) if given is None else mask)
        assert expected.motion[1] is expected.motion[2] is camera
    motion.after = object()
    prior._take(frame, flow, torch.device("cpu"))
    assert prior._expected is None, "the scope moves"


def test_learned_prior_without_usable_motion_predicts_nothing(monkeypatch):
    """For example after a cut, where the expected motion belongs to the previous scene."""
    prior = prior_of(1 / 30)
    prior._expected = object()
    monkeypatch.setattr(LearnedPrior, "_usable_motion", lambda self: None)
    assert prior.velocity(SimpleNamespace()) is None
