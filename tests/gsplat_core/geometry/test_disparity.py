"""Disparity of shifted random pictures with known truth, and its filter, reduction and enlargement in closed form."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.depth.stereo import Disparity, Span, enlarged, find_disparity, match, shrunk, smoothed

HEIGHT, WIDTH = 64, 96


@pytest.mark.parametrize(("low", "high"), [(3.0, 18.0), (3.2, 18.9), (-7.5, 7.4), (-7.5, 8.5), (0.0, 0.0), (2.9, 60.0)])
def test_span_around_is_smallest_multiple_of_16(low, high):
    span = Span.around(low, high)
    highest = span.lowest + span.count - 1
    assert span.lowest <= low < span.lowest + 1 and highest >= high
    assert span.count % 16 == 0 and (span.count == 16 or highest - 16 < high)


def texture(seed=0):
    rough = np.random.default_rng(seed).uniform(0, 255, (HEIGHT, WIDTH + 64)).astype(np.float32)
    smooth = cv2.GaussianBlur(rough, (0, 0), 1.2)
    return np.clip(128 + 3 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def pair():
    """A wall at 6 px with a square at 14 px before it, and the true disparity in the left picture."""
    wall, front = texture(0), texture(1)
    left, right = wall[:, 20 : 20 + WIDTH].copy(), wall[:, 26 : 26 + WIDTH].copy()
    left[20:44, 40:70], right[20:44, 26:56] = front[20:44, 40:70], front[20:44, 40:70]
    true = np.full((HEIGHT, WIDTH), 6.0)
    true[20:44, 40:70] = 14
    return left, right, true


def test_find_disparity_of_square_before_wall():
    left, right, true = pair()
    found = find_disparity(torch.from_numpy(left), torch.from_numpy(right), Span(0, 32))
    inner = np.zeros((HEIGHT, WIDTH), bool)
    inner[8:14, 30:90] = inner[26:38, 48:62] = True
    known, px, error = found.known.numpy(), found.px.numpy(), found.error_px.numpy()
    assert known[inner].mean() > 0.95
    assert np.abs(px - true)[inner & known].max() < 0.2 and np.percentile(error[inner & known], 90) < 0.5
    edge = np.zeros((HEIGHT, WIDTH), bool)
    edge[24:40, 39:41] = True
    assert 1.4 < np.median(error[edge & known]) < 5
    assert not known.all() and np.isinf(error[~known]).all() and not px[~known].any()
    coarse, is_known = match(left, right, Span(0, 32))
    assert np.abs(coarse - true)[inner & is_known].max() < 0.3 and not coarse[~is_known].any()
    np.testing.assert_array_equal(is_known, known)


def planes(px, error_px, known=None):
    known = np.ones(np.shape(px), bool) if known is None else known
    return Disparity(*(torch.from_numpy(np.asarray(each)) for each in (np.float32(px), known, np.float32(error_px))))


def halves(left, right):
    return np.where(np.arange(8)[None] < np.full((8, 1), 4), left, right)


def test_smoothed_disparity_weights_by_inverse_variance():
    """Inverse variances with a floor of 0.05 px² weigh 0.1 px 17 times as much as 1 px."""
    found = smoothed(planes(halves(10.0, 20.0), halves(0.1, 1.0)), torch.full((8, 8), 100, dtype=torch.uint8))
    assert 10 < found.px.mean() < 12.5
    # Without the floor a perfect value would outweigh 0.2 px without limit.
    floored = smoothed(planes(halves(10.0, 20.0), halves(1e-4, 0.2)), torch.full((8, 8), 100, dtype=torch.uint8))
    assert 13 < floored.px.mean() < 15.5


def test_smoothed_disparity_keeps_picture_edges_and_holes():
    known = np.ones((8, 8), bool)
    known[3, 3] = False
    guide = torch.from_numpy(halves(20, 220).astype(np.uint8))
    found = smoothed(planes(halves(10.0, 20.0), np.where(known, 0.2, np.inf), known), guide)
    np.testing.assert_allclose(found.px.numpy(), np.where(known, halves(10.0, 20.0), 0), atol=0.1)
    np.testing.assert_array_equal(found.known.numpy(), known)
    assert found.error_px[3, 3] == np.inf and found.error_px[0, 0] == pytest.approx(0.2)


def test_shrunk_picture_is_mean_of_blocks():
    picture = np.random.default_rng(0).integers(0, 256, (12, 18), np.uint8)
    np.testing.assert_array_equal(shrunk(picture, 1), picture)
    means = picture.reshape(4, 3, 6, 3).astype(float).mean((1, 3))
    assert shrunk(picture, 3).shape == (4, 6) and np.abs(shrunk(picture, 3) - means).max() <= 0.5


def test_enlarged_disparity_is_in_pixels_of_large_picture():
    small = planes(np.tile(np.arange(10.0), (6, 1)), np.full((6, 10), 0.25))
    large = enlarged(small, 30, 18)
    x = np.clip((np.arange(30) + 0.5) / 3 - 0.5, 0, 9)
    np.testing.assert_allclose(large.px.numpy(), np.tile(3 * x, (18, 1)), atol=1e-4)
    np.testing.assert_allclose(large.error_px.numpy(), 0.75, rtol=1e-5)
    assert large.known.all() and enlarged(small, 10, 6) is small


def test_enlarged_disparity_is_known_only_between_known_pixels():
    known = np.ones((6, 10), bool)
    known[2, 4] = False
    large = enlarged(planes(np.where(known, 5.0, 0), np.where(known, 0.25, np.inf), known), 20, 12)
    expected = np.ones((12, 20), bool)
    expected[3:7, 7:11] = False
    np.testing.assert_array_equal(large.known.numpy(), expected)
    np.testing.assert_allclose(large.px.numpy(), np.where(expected, 10, 0), atol=1e-5)
    assert torch.isinf(large.error_px[~large.known]).all() and torch.allclose(
        large.error_px[large.known], torch.tensor(0.5)
    )
