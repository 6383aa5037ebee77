"""`ToolFinder` finds tools at any tint, brightness, size and orientation, with few false detections."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope.tools import HELD_FRAMES, ToolFinder, view_of
from gsplat_core.errors import InvalidInput

SIZE = (256, 320)


def tissue(rng: np.random.Generator, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Red and pale patches with fine texture under uneven light."""
    height, width = size
    colours = np.array([[190, 95, 80], [215, 150, 120], [150, 55, 45], [205, 160, 150]], np.float32)
    weights = np.stack([cv2.GaussianBlur(rng.normal(0, 1, size).astype(np.float32), (0, 0), 18) for _ in colours], -1)
    weights = np.exp(8 * weights / np.abs(weights).max())
    picture = (weights / weights.sum(-1, keepdims=True)) @ colours
    y, x = np.mgrid[:height, :width]
    light = 1 - 0.5 * np.hypot((y / height - 0.5), (x / width - 0.5))
    fine = 1 + 0.05 * cv2.GaussianBlur(rng.normal(0, 1, size).astype(np.float32), (0, 0), 1)
    return np.clip(picture * (light * fine)[..., None], 0, 255).astype(np.uint8)


def shaft(size: tuple[int, int] = SIZE, shift_px: int = 0) -> np.ndarray:
    """True on an instrument that comes in from the lower right."""
    height, width = size
    flags = np.zeros(size, np.uint8)
    tip = (int(0.45 * width) + shift_px, int(0.45 * height) + shift_px)
    cv2.line(flags, tip, (width + 40, height + 20), 1, max(size) // 7)
    return flags.astype(bool)


def with_tool(picture: np.ndarray, tool: np.ndarray, colour: tuple[int, int, int] = (118, 124, 130)) -> np.ndarray:
    """The picture with a grey tool that has a sheen along its axis."""
    depth = cv2.distanceTransform(tool.astype(np.uint8), cv2.DIST_L2, 3)
    sheen = 0.6 + 0.6 * depth / depth.max()
    painted = np.clip(np.array(colour, np.float32) * sheen[..., None], 0, 255).astype(np.uint8)
    return np.where(tool[..., None], painted, picture)


def iou(mask: np.ndarray, tool: np.ndarray) -> float:
    found = mask == 0
    return float((found & tool).sum() / (found | tool).sum())


def gained(red: float, green: float, blue: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda image: np.clip(image * np.array([red, green, blue]), 0, 255).astype(np.uint8)


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as it is": lambda image: image,
    "dark": gained(0.35, 0.35, 0.35),
    "warm": gained(1.15, 1.0, 0.85),
    "cold": gained(0.8, 1.0, 1.1),
    "gamma": lambda image: (255 * (image / 255.0) ** 1.5).astype(np.uint8),
    "smoke": lambda image: (0.6 * image + 68).astype(np.uint8),
    "JPEG": lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 30])[1], 1),
}


@pytest.mark.parametrize("change", CHANGES)
def test_tool_finder_finds_grey_tool_in_any_light(rng, change):
    tool = shaft()
    image = CHANGES[change](with_tool(tissue(rng), tool))
    mask = ToolFinder().find(image)
    assert mask.dtype == np.uint8 and set(np.unique(mask)) == {0, 1}
    assert iou(mask, tool) > 0.8
    assert (mask[tool] == 0).mean() > 0.95  # tissue may be lost at the edge, tool pixels must not


@pytest.mark.slow
@pytest.mark.parametrize("flip", [0, 1, -1])
@pytest.mark.parametrize("size", [(128, 160), (257, 319), (512, 640), (1024, 1280), (576, 200)])
def test_tool_finder_independent_of_size_and_orientation(rng, size, flip):
    tool = cv2.flip(shaft(size).astype(np.uint8), flip).astype(bool)
    image = with_tool(cv2.flip(tissue(rng, size), flip), tool)
    assert iou(ToolFinder().find(image), tool) > 0.75


@pytest.mark.parametrize("colour", [(225, 228, 232), (40, 42, 46), (60, 110, 190), (60, 160, 80)])
def test_tool_finder_finds_tools_of_non_tissue_colours(rng, colour):
    tool = shaft()
    assert iou(ToolFinder().find(with_tool(tissue(rng), tool, colour)), tool) > 0.75


@pytest.mark.parametrize("change", CHANGES)
def test_tool_finder_finds_nothing_without_tool(rng, change):
    finder = ToolFinder()
    shares = [float((finder.find(CHANGES[change](tissue(rng))) == 0).mean()) for _ in range(3)]
    # A white balance that is far off makes the palest patches grey, and their outlines are sharp.
    assert max(shares) <= (0.06 if change == "cold" else 0)


def test_tool_finder_ignores_highlights(rng):
    image = tissue(rng)
    for at in rng.integers(30, 220, (25, 2)):
        cv2.ellipse(image, (int(at[0]), int(at[1])), (int(rng.integers(2, 16)), 3), 30, 0, 360, (255, 255, 255), -1)
    assert (ToolFinder().find(image) == 0).mean() == 0


def test_tool_finder_ignores_tissue_fading_to_grey(rng):
    image = tissue(rng).astype(np.float32)
    pale = np.clip(np.linspace(-1, 1.5, SIZE[1]), 0, 1)[None, :, None]
    washed_out = (image * (1 - pale) + 225 * pale).astype(np.uint8)
    assert (ToolFinder().find(washed_out) == 0).mean() == 0


def test_tool_finder_ignores_black_around_round_view(rng):
    inside = np.zeros(SIZE, np.uint8)
    cv2.circle(inside, (160, 128), 120, 1, -1)
    tool = shaft() & (inside == 1)
    image = with_tool(tissue(rng), shaft()) * inside[..., None]
    mask = ToolFinder().find(image)
    assert iou(mask, tool) > 0.75
    assert (ToolFinder().find(tissue(rng) * inside[..., None]) == 0).mean() == 0


def test_tool_finder_is_deterministic_with_constant_memory(rng):
    background = tissue(rng)
    images = [with_tool(background, shaft(shift_px=k)) for k in range(20)]
    finder, again = ToolFinder(), ToolFinder()
    masks = [finder.find(image) for image in images]
    for image, mask in zip(images, masks, strict=True):
        np.testing.assert_array_equal(again.find(image), mask)
    size = {name: np.size(value) for name, value in vars(finder).items()}
    for image in images:
        finder.find(image)
    assert {name: np.size(value) for name, value in vars(finder).items()} == size


def test_tool_finder_after_cut_or_reset_equals_new_finder(rng):
    red, finder = with_tool(tissue(rng), shaft()), ToolFinder()
    yellow = gained(0.9, 1.3, 0.5)(tissue(rng))
    other = with_tool(yellow, np.fliplr(shaft()), (150, 150, 150))
    for _ in range(10):
        finder.find(red)
    np.testing.assert_array_equal(finder.find(other), ToolFinder().find(other))
    finder.reset()
    np.testing.assert_array_equal(finder.find(red), ToolFinder().find(red))


def test_tool_finder_holds_vanished_tool_for_few_frames(rng):
    background, tool, finder = tissue(rng), shaft(), ToolFinder()
    for _ in range(5):
        finder.find(with_tool(background, tool))
    shares = [float((finder.find(background)[tool] == 0).mean()) for _ in range(HELD_FRAMES + 1)]
    assert all(share > 0.9 for share in shares[:HELD_FRAMES]) and shares[-1] == 0


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((64, 64, 3), np.uint8),
        np.full((64, 64, 3), 255, np.uint8),
        np.full((64, 64, 3), 128, np.uint8),
        np.full((1, 1, 3), 90, np.uint8),
        np.full((3, 2000, 3), 90, np.uint8),
        np.full((30, 3000, 3), 90, np.uint8),
        np.zeros((0, 5, 3), np.uint8),
    ],
    ids=["black", "white", "grey", "one pixel", "a line", "a band", "empty"],
)
def test_tool_finder_uniform_image_gives_full_mask(image):
    finder = ToolFinder()
    for _ in range(2):
        mask = finder.find(image)
        assert mask.shape == image.shape[:2] and mask.dtype == np.uint8 and mask.all()


def test_tool_finder_noise_gives_mask_of_image_size(rng):
    mask = ToolFinder().find(rng.integers(0, 256, (64, 96, 3), np.uint8))
    assert mask.shape == (64, 96) and set(np.unique(mask)) <= {0, 1}


def test_tool_finder_continues_after_size_change(rng):
    finder = ToolFinder()
    for size in [SIZE, (128, 300), (40, 40), SIZE]:
        tool = shaft(size)
        image = with_tool(tissue(rng, size), tool)
        np.testing.assert_array_equal(finder.find(image), ToolFinder().find(image))


def test_tool_finder_accepts_non_contiguous_image(rng):
    image = with_tool(tissue(rng), shaft())
    wide = np.concatenate([image, image], axis=1)
    np.testing.assert_array_equal(ToolFinder().find(wide[:, : SIZE[1]]), ToolFinder().find(image))


@pytest.mark.parametrize(
    "image", [np.zeros((8, 8), np.uint8), np.zeros((8, 8, 3), np.float32), np.zeros((8, 8, 4), np.uint8)]
)
def test_tool_finder_rejects_arrays_other_than_rgb_uint8(image):
    with pytest.raises(InvalidInput, match=r"image must be RGB uint8 \[H, W, 3\], got"):
        ToolFinder().find(image)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_view_of_brightness_is_largest_channel(channel):
    image = np.full((48, 64, 3), 40, np.uint8)
    image[..., channel] = 200
    view = view_of(image)
    assert (view.brightness == 200).all() and view.levels[200] == np.count_nonzero(view.inside)
