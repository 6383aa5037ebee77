"""`Deinterlacer`: interlaced video is detected and repaired; progressive video is unchanged."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsplat_core.endoscope import artefacts
from gsplat_core.endoscope.artefacts import Deinterlacer, comb_share, without_combs
from tests.gsplat_core.endoscope.clips import PLACES, clip, texture


def woven(images):
    """Combine the even lines of each picture with the odd lines of the next, as an interlaced camera does."""
    result = [image.copy() for image in images[:-1]]
    for image, later in zip(result, images[1:], strict=True):
        image[1::2] = later[1::2]
    return result


def psnr_db(images, true):
    error = np.mean([np.square(a.astype(float) - b).mean() for a, b in zip(images, true, strict=True)])
    return 10 * np.log10(255**2 / error)


@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_deinterlacer_returns_progressive_video_unchanged(recordings_dir, name):
    deinterlacer = Deinterlacer()
    for image in clip(recordings_dir, name):
        assert deinterlacer.process(image) is image
        assert comb_share(image) == 0


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("name", PLACES)
def test_deinterlacer_detects_interlacing_and_improves_psnr(recordings_dir, name):
    images = clip(recordings_dir, name)
    deinterlacer, given_images = Deinterlacer(), woven(images)
    repaired = [deinterlacer.process(image) for image in given_images]
    assert deinterlacer.interlaced
    late = slice(len(images) // 2, len(images) - 1)
    assert psnr_db(repaired[late], images[late]) > psnr_db(given_images[late], images[late]) + 4
    assert all(np.array_equal(after[::2], before[::2]) for after, before in zip(repaired, given_images, strict=True))


def test_without_combs_keeps_lines_of_static_areas():
    images = [image.copy() for image in texture(1, 20, 320, 256)]
    for image in images:
        image[:, :160] = images[0][:, :160]
    image = woven(images)[10]
    changed = (without_combs(image) != image).any(axis=2)
    assert changed[:, 170:].mean() > 5 * changed[:, :150].mean()


@pytest.mark.parametrize("pattern", ["lines", "noise", "chequers"])
def test_deinterlacer_ignores_single_patterned_image(pattern):
    rows, columns = np.indices((256, 320))
    odd = {
        "lines": np.where(rows % 2, 200, 40),
        "noise": np.random.default_rng(0).integers(0, 256, rows.shape),
        "chequers": np.where((rows + columns) % 2, 200, 40),
    }[pattern]
    picture = np.repeat(odd[..., None], 3, axis=2).astype(np.uint8)
    images, deinterlacer = [*texture(2, 20, 320, 256)[:10], picture, *texture(2, 20, 320, 256)[10:]], Deinterlacer()
    assert all(deinterlacer.process(image) is image for image in images)


def test_comb_share_of_sensor_noise_below_threshold():
    rng = np.random.default_rng(0)
    for image in texture(3, 20, 320, 256):
        noisy = np.clip(image + rng.normal(0, 12, image.shape), 0, 255).astype(np.uint8)
        assert comb_share(noisy) < artefacts.COMB_SHARE


def test_deinterlacer_stops_after_stream_becomes_progressive(monkeypatch):
    monkeypatch.setattr(artefacts, "FORGOTTEN_FRAMES", 15)
    images = [np.roll(image, 5 * k, axis=1) for k, image in enumerate(texture(4, 30, 320, 256))]
    deinterlacer = Deinterlacer()
    for image in woven(images):
        deinterlacer.process(image)
    assert deinterlacer.interlaced
    passed = [deinterlacer.process(image) is image for image in images]
    assert passed[15:] == [True] * 15


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(0, 2**32))
def test_deinterlacer_accepts_images_of_any_size(height, width, seed):
    rng = np.random.default_rng(seed)
    deinterlacer = Deinterlacer()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(artefacts, "COMBED_FRAMES", 1)
        for k in range(4):
            image = rng.integers(0, 256, (height, width, 3), np.uint8)
            image[1::2] //= 1 + k
            assert deinterlacer.process(image).shape == image.shape
            assert without_combs(cv2.flip(image, 1)).shape == image.shape


def lines(amplitude, slope=0, rows=34, columns=128):
    """A picture whose left half has odd lines brighter by `amplitude`, on a vertical ramp."""
    y, x = np.mgrid[:rows, :columns]
    grey = 20 + slope * y + amplitude * (y % 2) * (x < columns // 2)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize(("amplitude", "share"), [(4, 0.0), (6, 0.5), (60, 0.5)])
def test_comb_share_equals_share_of_image_with_visible_combs(amplitude, share):
    assert comb_share(lines(amplitude)) == share


@pytest.mark.parametrize(("slope", "share"), [(4, 0.5), (6, 0.0)])
def test_comb_share_ignores_combs_weaker_than_vertical_gradient(slope, share):
    """Lines two apart differ by twice the slope, and neighbouring lines by the amplitude on average."""
    assert comb_share(lines(12, slope)) == share


@pytest.mark.parametrize(("rows", "columns", "share"), [(33, 128, 0.0), (34, 60, 0.0), (34, 64, 0.5)])
def test_comb_share_zero_below_two_blocks(rows, columns, share):
    assert comb_share(lines(60, 0, rows, columns)) == share


@pytest.mark.parametrize(("combed", "interlaced"), [((0, 4, 8), False), ((0, 4, 8, 11), True), ((0, 4, 8, 12), False)])
def test_deinterlacer_requires_four_combed_images_of_twelve(combed, interlaced):
    deinterlacer = Deinterlacer()
    for k in range(20):
        deinterlacer.process(lines(60 if k in combed else 0))
    assert deinterlacer.interlaced == interlaced


def test_deinterlacer_remembers_interlacing_for_600_images_without_combs():
    deinterlacer = Deinterlacer()
    for _ in range(4):
        deinterlacer.process(lines(60))
    after = [deinterlacer.process(lines(0)) is not None and deinterlacer.interlaced for _ in range(600)]
    assert after == [True] * 599 + [False]


def test_without_combs_replaces_outlier_pixel_and_two_neighbours():
    image = np.full((12, 40, 3), 100, np.uint8)
    image[6] = 110
    image[5, 17:24] = 113
    image[5, 20] = 130
    image[8, 20] = 200
    repaired = without_combs(image)
    assert repaired[5, 16:25, 0].tolist() == [100, 113, 105, 105, 105, 105, 105, 113, 100]
    untouched = np.ones(image.shape, bool)
    untouched[5, 18:23] = untouched[[7, 9], 18:23] = False
    np.testing.assert_array_equal(repaired[untouched], image[untouched])


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("levels", "replaced"), [(4, False), (5, True)])
def test_without_combs_excess_threshold(sign, levels, replaced):
    image = np.full((9, 20, 3), 100, np.uint8)
    image[3, 10] = 100 + sign * levels
    assert (without_combs(image)[3, 10, 0] == 100) == replaced
