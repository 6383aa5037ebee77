"""A scene that starts on a plane, and is moved to where depth by parallax says it is."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthOrigin, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining
from tests.gsplat_core.geometry.moving_scope import FIRST, HEIGHT, SIDEWAYS, WIDTH, depth_of_surface, video

INSIDE = np.s_[12:-12, 12:-12]


def learner() -> Reconstructor:
    return Reconstructor(ReconstructorConfig(gaussians=1500, max_gaussians=2000, first_frame_steps=8), FIRST)


def stream(count: int) -> list[Frame]:
    frames, cameras = video(count, SIDEWAYS)
    return [
        frame.with_fields(seq=number, pts_ns=number * 33_333_333, pose=camera.world_to_camera)
        for number, (frame, camera) in enumerate(zip(frames, cameras, strict=True))
    ]


def with_depth(frame: Frame, origin: DepthOrigin, factor: float = 1.0) -> Frame:
    # The surface as the first camera sees it: near enough for one that moved by a hundredth of its distance.
    return frame.with_fields(depth=factor * depth_of_surface(), depth_origin=origin)


def shown(reconstructor: Reconstructor, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Depth and picture at the frame's time, from where it was taken."""
    model = reconstructor.snapshot()
    assert frame.pose is not None
    output = render(model.at(frame.time_s), FIRST.with_pose(frame.pose), depth=True)
    return output.depth.numpy(), output.image.numpy()


def test_the_scene_goes_to_the_first_depth_at_once_and_looks_the_same() -> None:
    reconstructor, frames = learner(), stream(3)
    reconstructor.observe(frames[0])
    before, picture = shown(reconstructor, frames[0])
    assert np.median(before[INSIDE]) == pytest.approx(60, rel=0.01)
    again = frames[0].with_fields(seq=1)
    reconstructor.observe(with_depth(again, DEPTH_ORIGINS["parallax"]), steps=1)
    depth, same = shown(reconstructor, frames[0])
    assert np.median(np.abs(depth / depth_of_surface() - 1)[INSIDE]) < 0.02
    image = frames[0].image / 255
    assert np.abs(same - image)[INSIDE].mean() < np.abs(picture - image)[INSIDE].mean() + 0.03


def test_later_depth_moves_it_half_of_the_way() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(frames[0])
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["parallax"]), steps=1)
    reconstructor.observe(with_depth(frames[0].with_fields(seq=2), DEPTH_ORIGINS["parallax"], 1.21), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median((depth / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02)


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["measured"], DEPTH_ORIGINS["stereo"]])
def test_depth_that_is_not_of_parallax_moves_tissue_at_its_own_time(origin) -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], origin))
    later = frames[0].with_fields(seq=1, pts_ns=2_000_000_000)
    reconstructor.observe(with_depth(later, origin, 1.21), steps=1)
    (first, before), (moved, picture) = shown(reconstructor, frames[0]), shown(reconstructor, later)
    assert np.median(np.abs(first / depth_of_surface() - 1)[INSIDE]) < 0.02, "as it was"
    assert np.median((moved / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02), "half of the way"
    assert np.abs(picture - before)[INSIDE].mean() < 0.03


def test_what_the_depth_does_not_show_goes_along_with_what_is_around_it() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], DEPTH_ORIGINS["stereo"]))
    later = with_depth(frames[0].with_fields(seq=1, pts_ns=2_000_000_000), DEPTH_ORIGINS["stereo"], 1.21)
    hole = later.depth.copy()
    hole[20:44, 24:48] = 0
    reconstructor.observe(later.with_fields(depth=hole), steps=1)
    moved, _ = shown(reconstructor, later)
    assert np.median((moved / depth_of_surface())[24:40, 28:44]) == pytest.approx(1.1, rel=0.03)


def test_depth_by_light_moves_nothing_once_there_is_depth() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], DEPTH_ORIGINS["stereo"]))
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["light"], 1.21), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(np.abs(depth / depth_of_surface() - 1)[INSIDE]) < 0.02


def test_depth_that_is_believed_nowhere_places_nothing() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(frames[0])
    blind = with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["parallax"])
    blind = blind.with_fields(depth_confidence=np.zeros((HEIGHT, WIDTH), np.float32))
    reconstructor.observe(blind, steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(depth[INSIDE]) > 50


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["stereo"], DEPTH_ORIGINS["parallax"]])
def test_a_field_whose_positions_cannot_be_set_is_trained_as_it_is(origin) -> None:
    config = ReconstructorConfig(field="hexplane", gaussians=200, max_gaussians=300, first_frame_steps=2)
    reconstructor, frames = Reconstructor(config, FIRST), stream(1)
    reconstructor.observe(frames[0])
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), origin), steps=1)
    reconstructor.observe(with_depth(frames[0].with_fields(seq=2), origin), steps=1)


def test_a_scene_whose_first_depth_is_possible_nowhere_is_placed_by_the_next_one() -> None:
    reconstructor, frames = learner(), stream(1)
    blind = with_depth(frames[0], DEPTH_ORIGINS["stereo"])
    reconstructor.observe(blind.with_fields(depth_confidence=np.zeros((HEIGHT, WIDTH), np.float32)))
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["stereo"]), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(np.abs(depth / depth_of_surface() - 1)[INSIDE]) < 0.02


def test_live_the_depth_that_a_frame_comes_with_moves_the_scene_after_it_was_shown() -> None:
    """The first one starts the scene; those after it wait for `grow`, so that no picture waits for them."""
    config = ReconstructorConfig(gaussians=1500, max_gaussians=2000, squared_error=True)
    reconstructor, frames = Reconstructor(config, FIRST, live=LiveTraining()), stream(1)
    reconstructor.observe(with_depth(frames[0], DEPTH_ORIGINS["measured"]), steps=8)
    later = frames[0].with_fields(seq=1, pts_ns=2_000_000_000)
    reconstructor.observe(with_depth(later, DEPTH_ORIGINS["measured"], 1.21), steps=0)
    assert np.median((shown(reconstructor, later)[0] / depth_of_surface())[INSIDE]) == pytest.approx(1, rel=0.02)
    reconstructor.grow(later)
    assert np.median((shown(reconstructor, later)[0] / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02)
    reconstructor.grow(later)
    depth, _ = shown(reconstructor, later)
    assert np.median((depth / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02), "once for each frame"
