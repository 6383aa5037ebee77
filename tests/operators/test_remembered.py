"""Tissue outside the current view is marked, and all other pixels stay unchanged."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from gsplat_core.io.sessions.segments import TrackWriter
from gsplat_core.training.metrics import psnr_tissue_db
from operators.display import COVERED, RememberedTissue, marked
from tests.operators.conftest import make_frame, make_rendered


def blobs(rng, size):
    """1 in places, 0 in others, uint8."""
    return (cv2.GaussianBlur(rng.random(size).astype(np.float32), (0, 0), 2) > 0.5).astype(np.uint8)


def picture_of(rng, size, **fields):
    """A reconstruction of noise by noise, as opaque as chance has it."""
    image, shown = (rng.integers(0, 256, (*size, 3), np.uint8) for _ in range(2))
    alpha = rng.random(size).astype(np.float32)
    return make_rendered(
        0, frame=make_frame(0, image=image, **fields), image=shown, depth=np.ones(size, np.float32), alpha=alpha
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (7, 5), (48, 64), (333, 90), (700, 640)])
@pytest.mark.parametrize("masks", [("mask",), ("loss_mask",), ("mask", "loss_mask"), ()])
def test_mark_changes_only_covered_pixels_outside_visible_tissue(rng, size, masks):
    tissue = RememberedTissue()
    for _ in range(2):
        rendered = picture_of(rng, size, **{name: blobs(rng, size) for name in masks})
        seen = np.ones(size, np.uint8) if not masks else rendered.frame.tissue
        expected = (seen == 0) & (rendered.alpha >= COVERED)
        layer = tissue.layer(rendered)
        assert (layer is None) == (not expected.any())
        picture = rendered.image.copy()
        if layer is not None:
            assert layer.dtype == np.uint8 and np.array_equal(layer, np.where(expected, 255, 0))
            tissue.mark(picture, layer, rendered.frame.mask)
        assert np.array_equal(picture[~expected], rendered.image[~expected])
        assert (np.ptp(picture[expected], axis=-1) == 0).all(), "without colour"
        before = psnr_tissue_db(rendered.image, rendered.frame.image, seen)
        after = psnr_tissue_db(picture, rendered.frame.image, seen)
        assert before == after or np.isnan([before, after]).all()
        assert np.array_equal(marked(rendered), picture)


def test_remembered_tissue_is_darker_with_line_along_tissue_only():
    size = (400, 500)
    mask, view = np.ones(size, np.uint8), np.ones(size, np.uint8)
    mask[100:200, 300:] = 0
    view[:, :50] = 0
    frame = make_frame(0, image=np.full((*size, 3), (180, 90, 80), np.uint8), mask=mask, loss_mask=view)
    flat = {name: np.ones(size, np.float32) for name in ("depth", "alpha")}
    rendered = make_rendered(0, frame=frame, image=frame.image, **flat)
    picture = marked(rendered)
    inside = picture[110:190, 310:]
    assert (inside == inside[0, 0]).all() and inside[0, 0, 0] < frame.image.mean()
    assert (picture[100, 300:] == 255).all() and (picture[100:200, 300] == 255).all(), "a line"
    assert (picture[99, 290:] == frame.image[0, 0]).all(), "inside of what is remembered"
    assert (picture[:, :50] == inside[0, 0]).all(), "no line at the rim of the view"
    assert (picture[120:180, -1] == inside[0, 0]).all(), "nor at that of the picture"


def test_tissue_uncovered_by_tool_is_live_immediately(rng):
    tissue, size = RememberedTissue(), (48, 64)
    before, after = np.ones(size, np.uint8), np.ones(size, np.uint8)
    before[:, :30], after[:, 20:50] = 0, 0
    alpha = np.ones(size, np.float32)
    for mask in (before, after):
        frame = make_frame(0, image=rng.integers(0, 256, (*size, 3), np.uint8), mask=mask)
        rendered = make_rendered(0, frame=frame, image=frame.image, alpha=alpha, depth=alpha)
        assert np.array_equal(tissue.layer(rendered), np.where(mask, 0, 255))


def test_remembered_layer_uses_mask_of_content_frame():
    size = make_frame().image.shape[:2]
    tool = np.ones(size, np.uint8)
    tool[2:9] = 0
    rendered = make_rendered(5, frame=make_frame(5, withheld="blur"), content=make_frame(3, mask=tool))
    assert np.array_equal(RememberedTissue().layer(rendered), np.where(tool, 0, 255))


def test_whole_remembered_layer_excludes_uncovered_pixels(rng):
    rendered = picture_of(rng, (20, 30))
    layer = RememberedTissue().layer(rendered, whole=True)
    assert np.array_equal(layer > 0, rendered.alpha >= COVERED)
    other = make_rendered(1, content=make_frame(0, image=np.zeros((9, 9, 3), np.uint8), mask=np.ones((9, 9), np.uint8)))
    assert RememberedTissue().layer(other).all(), "nothing of another size is in it"


def test_remembered_marking_survives_video_coding(tmp_path):
    """Code the picture as the recorder does: 4:2:0, lossy."""
    size = (256, 320)
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.integers(0, 256, (*size, 3), np.uint8), (0, 0), 3).astype(np.float32)
    tissue = np.clip((noise - 128) * 2 + (190, 90, 70), 0, 255).astype(np.uint8)
    mask = np.ones(size, np.uint8)
    cv2.line(mask, (330, 60), (150, 140), 0, 40)
    flat = {name: np.ones(size, np.float32) for name in ("depth", "alpha")}
    picture = marked(make_rendered(0, frame=make_frame(0, image=tissue, mask=mask), image=tissue, **flat))
    track = TrackWriter(tmp_path / "shown.mkv", "vp9", *size, 30.0)
    for k in range(5):
        track.write(picture, 33 * k)
    track.close()
    with av.open(tmp_path / "shown.mkv") as video:
        *_, last = video.decode(video=0)
    decoded = last.to_ndarray(format="rgb24").astype(int)
    colour = np.ptp(decoded, axis=-1)
    inside = cv2.erode(1 - mask, np.ones((9, 9))) > 0
    assert colour[inside].mean() < 12 < 80 < colour[cv2.erode(mask, np.ones((9, 9))) > 0].mean()
    line = (picture == 255).all(-1) & (mask == 0)
    assert decoded[line].mean() > decoded[inside].mean() + 80
