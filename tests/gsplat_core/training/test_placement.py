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


def test_first_depth_places_scene_and_keeps_picture() -> None:
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


def test_later_depth_moves_scene_half_way() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(frames[0])
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["parallax"]), steps=1)
    reconstructor.observe(with_depth(frames[0].with_fields(seq=2), DEPTH_ORIGINS["parallax"], 1.21), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median((depth / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02)


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["measured"], DEPTH_ORIGINS["stereo"]])
def test_measured_depth_moves_tissue_only_at_its_time(origin) -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], origin))
    later = frames[0].with_fields(seq=1, pts_ns=2_000_000_000)
    reconstructor.observe(with_depth(later, origin, 1.21), steps=1)
    (first, before), (moved, picture) = shown(reconstructor, frames[0]), shown(reconstructor, later)
    assert np.median(np.abs(first / depth_of_surface() - 1)[INSIDE]) < 0.02, "as it was"
    assert np.median((moved / depth_of_surface())[INSIDE]) == pytest.approx(1.1, rel=0.02), "half of the way"
    assert np.abs(picture - before)[INSIDE].mean() < 0.03


def test_placement_moves_unknown_depth_with_surroundings() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], DEPTH_ORIGINS["stereo"]))
    later = with_depth(frames[0].with_fields(seq=1, pts_ns=2_000_000_000), DEPTH_ORIGINS["stereo"], 1.21)
    hole = later.depth.copy()
    hole[20:44, 24:48] = 0
    reconstructor.observe(later.with_fields(depth=hole), steps=1)
    moved, _ = shown(reconstructor, later)
    assert np.median((moved / depth_of_surface())[24:40, 28:44]) == pytest.approx(1.1, rel=0.03)


def test_depth_by_light_does_not_move_placed_scene() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(with_depth(frames[0], DEPTH_ORIGINS["stereo"]))
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["light"], 1.21), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(np.abs(depth / depth_of_surface() - 1)[INSIDE]) < 0.02


def test_depth_without_confidence_places_nothing() -> None:
    reconstructor, frames = learner(), stream(1)
    reconstructor.observe(frames[0])
    blind = with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["parallax"])
    blind = blind.with_fields(depth_confidence=np.zeros((HEIGHT, WIDTH), np.float32))
    reconstructor.observe(blind, steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(depth[INSIDE]) > 50


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["stereo"], DEPTH_ORIGINS["parallax"]])
def test_hexplane_scene_with_depth_is_trained_without_placement(origin) -> None:
    config = ReconstructorConfig(field="hexplane", gaussians=200, max_gaussians=300, first_frame_steps=2)
    reconstructor, frames = Reconstructor(config, FIRST), stream(1)
    reconstructor.observe(frames[0])
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), origin), steps=1)
    reconstructor.observe(with_depth(frames[0].with_fields(seq=2), origin), steps=1)


def test_scene_is_placed_by_second_depth_if_first_is_unusable() -> None:
    reconstructor, frames = learner(), stream(1)
    blind = with_depth(frames[0], DEPTH_ORIGINS["stereo"])
    reconstructor.observe(blind.with_fields(depth_confidence=np.zeros((HEIGHT, WIDTH), np.float32)))
    reconstructor.observe(with_depth(frames[0].with_fields(seq=1), DEPTH_ORIGINS["stereo"]), steps=1)
    depth, _ = shown(reconstructor, frames[0])
    assert np.median(np.abs(depth / depth_of_surface() - 1)[INSIDE]) < 0.02


def test_live_recorded_depth_moves_scene_at_grow() -> None:
    """The first depth starts the scene; later depths wait for `grow`, so that no picture is delayed."""
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
