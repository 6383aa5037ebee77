"""Small pictures and masks from large ones, and back, of any size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope.reduced import averaged, enlarged, median_of, reduced_mask, sampled_mask


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (40, 30)])
@pytest.mark.parametrize("larger", [(1, 0, 0), (2, 0, 0), (3, 0, 0), (2, 1, 0), (2, 1, 1), (3, 2, 2)])
def test_enlarged_equals_nearest_neighbour_resize(rng, size, larger):
    step, right, below = larger
    plane = rng.integers(0, 256, size, np.uint8)
    width, height = step * size[1] + right, step * size[0] + below
    large = enlarged(plane, width, height)
    assert large.flags.c_contiguous and large.dtype == np.uint8
    assert np.array_equal(large, cv2.resize(plane, (width, height), interpolation=cv2.INTER_NEAREST))


@pytest.mark.parametrize("kind", [np.uint8, np.bool_, np.float32, np.int64])
@pytest.mark.parametrize("step", [1, 2, 7])
def test_sampled_mask_independent_of_dtype(rng, kind, step):
    mask = rng.random((33, 50)) > 0.4
    expected = sampled_mask(mask.astype(np.uint8) * 200, step)
    assert set(np.unique(expected)) <= {0, 1}
    assert np.array_equal(sampled_mask(mask.astype(kind), step), expected)
    assert np.array_equal(reduced_mask(mask.astype(kind), 5, 4), reduced_mask(mask, 5, 4))


@pytest.mark.parametrize("size", [(16, 16), (31, 47), (240, 320), (512, 640)])
@pytest.mark.parametrize("samples", [1, 2, 3])
def test_averaged_keeps_colour_and_reduces_noise(rng, size, samples):
    noisy = np.clip(rng.normal((150, 90, 60), 20, (*size, 3)), 0, 255).astype(np.uint8)
    small = averaged(noisy, (8, 8), samples)
    assert small.shape == (8, 8, 3)
    assert np.abs(small.mean(axis=(0, 1)) - (150, 90, 60)).max() < 20
    averaged_px = min(samples, size[0] // 8, size[1] // 8) ** 2
    assert small.std(axis=(0, 1)).max() < 20 * 1.6 / averaged_px**0.5


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_median_of_returns_requested_quantile(rng, count, share):
    values = rng.random(count)
    assert median_of(values, share) == np.sort(values)[int(share * count)]


def test_averaged_equals_mean_of_sampled_pixels(rng):
    """Two samples per side of a result pixel are the upper left of every 2x2 pixels; a single one averages all of them."""
    image = rng.integers(0, 256, (32, 48, 3), np.uint8)
    mean = lambda some: some.reshape(8, some.shape[0] // 8, 12, some.shape[1] // 12, 3).mean(axis=(1, 3))
    assert np.abs(averaged(image, (12, 8), 2) - mean(image[::2, ::2])).max() <= 0.5
    assert np.abs(averaged(image, (12, 8), 4) - mean(image)).max() <= 0.5
    assert np.abs(averaged(image, (12, 8), 9) - mean(image)).max() <= 0.5, "there are only four"
    assert np.abs(averaged(image, (12, 8), 1) - mean(image)).max() <= 0.5
