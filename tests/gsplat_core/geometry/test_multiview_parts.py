"""Choice of views, distances of a sweep and what is filled in, in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gsplat_core.depth import multiview
from gsplat_core.depth.maps import DepthMap
from gsplat_core.depth.multiview import ParallaxDepth, chosen_views, view_of
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import PARALLAX, Frame


def view(x, turn=0.0):
    pose = np.eye(4)
    pose[2, :3] = [np.sin(turn), 0, np.cos(turn)]
    return SimpleNamespace(camera=SimpleNamespace(world_to_camera=pose, position=np.array([x, 0.0, 0.0])), x=x)


@pytest.mark.parametrize(
    ("at", "chosen"),
    [
        ([10, 1, 0.99, 0], [1, 10]), ([5], [5]), ([0], []), ([], []), (list(range(1, 7)), [1, 2, 3, 4, 5, 6]),
        (list(range(1, 12)), [2, 4, 6, 7, 9, 11]),
    ],
)  # fmt: skip
def test_chosen_views_are_six_with_at_least_tenth_of_longest_baseline(at, chosen):
    found = [each.x for each in chosen_views(view(0.0), [view(float(x)) for x in at])]
    assert found == chosen


@pytest.mark.parametrize(("cosine", "is_taken"), [(0.71, True), (0.69, False), (-1.0, False)])
def test_views_facing_elsewhere_are_left_out(cosine, is_taken):
    assert len(chosen_views(view(0.0), [view(5.0, np.arccos(cosine))])) == is_taken


@pytest.mark.parametrize(("parallax_px", "count"), [(1.0, 24), (30.0, 66), (500.0, 96)])
def test_swept_distances_are_three_quarters_of_pixel_apart(parallax_px, count):
    """Expected value between corners at 1/50 and 1/100, 1.6 times farther and nearer: 0.032 - 0.00625 = 0.02575."""
    found = SimpleNamespace(inverse_depths=np.repeat([0.01, 0.02], 50), parallax_px=parallax_px, plane=0.0156)
    inverse = multiview._distances(found)
    assert (inverse[0], inverse[-1]) == pytest.approx((0.01 / 1.6, 0.02 * 1.6))
    assert len(inverse) == count
    np.testing.assert_allclose(np.diff(inverse), (0.032 - 0.00625) / (count - 1))


def test_unconfident_depth_continues_confident_depth_with_confidence_at_most_a_fifth():
    inverse, confidence = np.full((40, 60), 0.5, np.float32), np.full((40, 60), 0.4, np.float32)
    inverse[:, :30], confidence[:, :30] = 0.02, 0.9
    confidence[:, 50:] = 0.1
    found, sure = multiview._filled(inverse, confidence, SimpleNamespace(plane=0.03))
    np.testing.assert_array_equal(found[:, :30], np.float32(0.02))
    assert found[:, 30:].min() >= 0.02 and found[:, 30:].max() < 0.0301
    assert found[20, 31] == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(sure[5, [0, 31, 55]], [0.9, 0.2, 0.1])


@pytest.mark.parametrize(("side", "is_kept"), [(2, False), (3, True)])
def test_patches_below_fourteen_per_ten_thousand_pixels_are_speckles(side, is_kept):
    """In a picture of 5,000 pixels the limit is 7 pixels."""
    labels, confidence = np.full((50, 100), 10.0, np.float32), np.zeros((50, 100), np.float32)
    labels[20 : 20 + side, 20 : 20 + side], confidence[20 : 20 + side, 20 : 20 + side] = 14.0, 0.9
    found = multiview._without_speckles(labels, confidence)
    assert found[20, 20] == pytest.approx(0.9 if is_kept else 0.2) and found[0, 0] == 0


@pytest.mark.parametrize(("step", "is_kept"), [(1, True), (2, False), (-1, True), (-2, False)])
def test_patch_within_one_and_a_half_labels_of_surroundings_is_no_speckle(step, is_kept):
    labels, confidence = np.full((50, 100), 10.0, np.float32), np.full((50, 100), 0.8, np.float32)
    labels[20:22, 20:22] += step
    found = multiview._without_speckles(labels, confidence)
    assert found[20, 20] == pytest.approx(0.8 if is_kept else 0.2) and found[0, 0] == pytest.approx(0.8)


@pytest.mark.parametrize("is_right", [True, False])
def test_first_depth_of_stream_waits_for_agreeing_second(monkeypatch, is_right):
    """The scope slides by 1 per frame before waves. A second depth that is deep where the first is high contradicts it."""
    waves = 60 + 15 * np.sin(np.arange(64, dtype=np.float32) / 6)
    seen = iter([waves, waves if is_right else 120 - waves])

    def depth_of_view(view, others, size):
        return DepthMap(np.tile(next(seen), (size[0], 1)), np.ones(size, np.float32), PARALLAX, metric=False)

    monkeypatch.setattr(multiview, "depth_of_view", depth_of_view)
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    estimator, found = ParallaxDepth(), []
    for seq in range(3):
        pose = np.eye(4)
        pose[0, 3] = -float(seq)
        camera = Camera.from_focal(60.0, 64, 48, pose)
        found.append(estimator.estimate(Frame(seq, seq * 250_000_000, image, pose=pose), camera))
    assert found[:2] == [None, None] and found[2] is not None
    assert (found[2].doubt is None) == is_right and found[2].confidence.any() == is_right


@pytest.mark.parametrize("doubt", [None, "too dark"])
def test_stream_depth_without_confident_pixels_is_doubted(monkeypatch, doubt):
    def depth_of_view(view, others, size):
        return DepthMap(np.full(size, 60, np.float32), np.zeros(size, np.float32), PARALLAX, metric=False, doubt=doubt)

    monkeypatch.setattr(multiview, "depth_of_view", depth_of_view)
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    estimator = ParallaxDepth()
    for seq in range(2):
        pose = np.eye(4)
        pose[0, 3] = -float(seq)
        found = estimator.estimate(Frame(seq, seq, image, pose=pose), Camera.from_focal(60.0, 64, 48, pose))
    assert found is not None and found.doubt == (doubt or multiview.DEFORMS)


@pytest.mark.parametrize(("size", "small"), [((80, 60), (80, 60)), ((200, 100), (100, 50)), ((100, 200), (50, 100))])
def test_view_is_reduced_to_longest_side_and_masked_to_tissue(size, small):
    width, height = size
    mask, inside = np.ones((2, height, width), np.uint8)
    mask[: height // 2], inside[:, : width // 2] = 0, 0
    frame = Frame(0, 0, np.full((height, width, 3), 90, np.uint8), mask=mask, loss_mask=inside)
    view = view_of(frame, Camera.from_focal(50.0, width, height), 100)
    assert view.grey.shape == view.tissue.shape == small[::-1]
    assert (view.camera.width_px, view.camera.height_px) == small
    expected = np.zeros(small[::-1], np.uint8)
    expected[small[1] // 2 :, small[0] // 2 :] = 1
    np.testing.assert_array_equal(view.tissue, expected)
