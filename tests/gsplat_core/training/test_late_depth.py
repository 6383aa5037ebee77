"""Depth that a live model learns after the frame that it is of: rehearsal looks at it, the scene goes there, and what is gone is left alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthOrigin, DepthSource, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.placement import MOST_LATE, LateDepth
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import LiveTraining

WIDTH, HEIGHT = 48, 40
CAMERA = Camera.from_focal(40.0, WIDTH, HEIGHT)
PLANE = 60.0
"""Initial distance of a scene without depth."""


def frame_at(k: int, **fields: object) -> Frame:
    x = np.linspace(0, 3, fields.pop("width", WIDTH))[None, :] + 0.02 * k
    y = np.linspace(0, 2, HEIGHT)[:, None]
    planes = np.stack([np.sin(x + y), np.cos(x - y), np.sin(2 * x) * np.cos(y)], -1)
    return Frame(k, k * 33_000_000, ((planes + 1) * 95 + 10).astype(np.uint8), **fields)


def found(frame: Frame, depth: float | np.ndarray = 80.0, origin: DepthOrigin = DEPTH_ORIGINS["stereo"]) -> Frame:
    plane = np.broadcast_to(np.asarray(depth, np.float32), frame.image.shape[:2]).copy()
    eye = CAMERA.right_eye(5.0) if origin is DEPTH_ORIGINS["stereo"] else None
    return frame.with_fields(depth=plane, depth_confidence=np.ones_like(plane), depth_origin=origin, right_camera=eye)


def learner(frames: int = 3, **config: object) -> Reconstructor:
    settings = {"gaussians": 300, "max_gaussians": 400, "window_frames": 40, "depth_weight": 0.1, **config}
    made = Reconstructor(ReconstructorConfig(**settings), CAMERA, live=LiveTraining())
    for k in range(frames):
        made.observe(frame_at(k), steps=3)
    return made


def distance(made: Reconstructor, k: int) -> float:
    with torch.no_grad():
        output = render(made.snapshot().at(frame_at(k).time_s), CAMERA, depth=True)
    return float(output.depth.median())


def test_first_late_depth_places_scene_and_keeps_picture() -> None:
    made = learner()
    before = render(made.snapshot().at(frame_at(1).time_s), CAMERA).image
    assert distance(made, 2) == pytest.approx(PLANE, rel=0.02) and made.snapshot().depth_source is None
    assert made.take_depth(found(frame_at(1)))
    assert distance(made, 2) == pytest.approx(80, rel=0.02)
    after = render(made.snapshot().at(frame_at(1).time_s), CAMERA).image
    assert float((after - before).abs().mean()) < 0.03
    assert made.snapshot().depth_source == DepthSource(DEPTH_ORIGINS["stereo"], metric=True)


@pytest.mark.slow
def test_rehearsal_trains_on_late_depth() -> None:
    """Placing does not provide the slope: only the loss applies all depth after the first."""
    slope = np.linspace(70, 90, WIDTH, dtype=np.float32)[None, :]

    def error(late: bool) -> float:
        made = learner(2)
        assert made.take_depth(found(frame_at(0)))
        if late:
            assert made.take_depth(found(frame_at(1), slope))
        made.rehearse(150)
        with torch.no_grad():
            depth = render(made.snapshot().at(frame_at(1).time_s), CAMERA, depth=True).depth.numpy()
        return float(np.abs(depth - slope).mean())

    assert error(late=True) < 0.7 * error(late=False)


@pytest.mark.parametrize("origin", [DEPTH_ORIGINS["light"], DEPTH_ORIGINS["parallax"]])
def test_relative_late_depth_places_scene_without_unit(origin: DepthOrigin) -> None:
    made = learner()
    assert made.take_depth(found(frame_at(0), 75.0, origin))
    assert distance(made, 0) == pytest.approx(75, rel=0.02)
    assert made.snapshot().depth_source == DepthSource(origin, metric=False)
    made.take_depth(found(frame_at(1)))
    assert made.snapshot().depth_source == DepthSource(origin, metric=False)


def test_late_depth_by_light_is_not_used_by_loss() -> None:
    made = learner()
    made.take_depth(found(frame_at(0), 75.0, DEPTH_ORIGINS["light"]))
    assert made._window.find(0, MOST_LATE).depth is None


@pytest.mark.parametrize(
    ("origin", "goes_to"), [(DEPTH_ORIGINS["stereo"], (50 * 80) ** 0.5), (DEPTH_ORIGINS["light"], 50.0)]
)
def test_late_depth_corrects_scene_that_started_from_depth(origin: DepthOrigin, goes_to: float) -> None:
    made = Reconstructor(ReconstructorConfig(gaussians=300, max_gaussians=400), CAMERA, live=LiveTraining())
    made.observe(frame_at(0, depth=np.full((HEIGHT, WIDTH), 50, np.float32)), steps=3)
    made.observe(frame_at(1), steps=3)
    assert made.take_depth(found(frame_at(1), 80.0, origin))
    assert distance(made, 1) == pytest.approx(goes_to, rel=0.02)


def another_scene(made: Reconstructor) -> None:
    other = frame_at(3)
    other = other.with_fields(image=255 - other.image)
    made.begin_scene(other)
    made.observe(other, steps=3)


def another_size(made: Reconstructor) -> None:
    wide = frame_at(3, width=2 * WIDTH)
    made.begin_scene(wide)
    made.observe(wide, steps=3)


def a_scene_that_has_not_begun(made: Reconstructor) -> None:
    made.begin_scene(frame_at(3))


def withheld(made: Reconstructor) -> None:
    made.observe(frame_at(3), train=False)
    assert not made.take_depth(found(frame_at(3)))
    made.forget()
    made.observe(frame_at(4), steps=1)


def long_ago(made: Reconstructor) -> None:
    for k in range(3, 3 + MOST_LATE):
        made.observe(frame_at(k), steps=1)


@pytest.mark.parametrize("overtakes", [another_scene, another_size, a_scene_that_has_not_begun, withheld, long_ago])
def test_late_depth_of_outdated_frame_is_rejected(overtakes: Callable[[Reconstructor], None]) -> None:
    made, untouched = learner(), learner()
    overtakes(made)
    overtakes(untouched)
    for k in (0, 1, 2):
        assert not made.take_depth(found(frame_at(k)))
    for each in (made, untouched):
        each.observe(frame_at(50, width=each.camera.width_px), steps=3)
        each.rehearse(5)
    assert made.snapshot().sha256() == untouched.snapshot().sha256()


def test_late_depth_training_is_deterministic() -> None:
    def model() -> str:
        made = learner()
        made.rehearse(2)
        made.take_depth(found(frame_at(2)))
        made.rehearse(7)
        made.observe(frame_at(3), steps=2)
        made.take_depth(found(frame_at(2), 70.0))
        made.rehearse(3)
        return made.snapshot().sha256()

    assert model() == model()


def test_late_depth_places_scene_after_cut() -> None:
    made = learner()
    made.take_depth(found(frame_at(1)))
    another_scene(made)
    assert distance(made, 3) == pytest.approx(PLANE, rel=0.02) and made.snapshot().depth_source is None
    assert made.take_depth(found(frame_at(3), 100.0))
    assert distance(made, 3) == pytest.approx(100, rel=0.02)


@pytest.mark.cuda
def test_late_depth_places_scene_on_cuda(gpu: torch.device) -> None:
    config = ReconstructorConfig(gaussians=300, max_gaussians=400, preallocate=True, depth_weight=0.1)
    made = Reconstructor(config, CAMERA, device="cuda", live=LiveTraining())
    for k in range(3):
        made.observe(frame_at(k), steps=3)
    assert made.take_depth(found(frame_at(1)))
    assert distance_on_gpu(made, 2) == pytest.approx(80, rel=0.02)
    made.rehearse(20)
    assert distance_on_gpu(made, 2) == pytest.approx(80, rel=0.02)


def distance_on_gpu(made: Reconstructor, k: int) -> float:
    with torch.no_grad():
        output = render(made.snapshot().at(frame_at(k).time_s), CAMERA, depth=True)
    return float(output.depth.median().cpu())


@pytest.mark.parametrize("known", [0, 1, 48 * 64])
def test_late_depth_of_has_planes_only_if_depth_is_known(known: int) -> None:
    depth = np.zeros(48 * 64, np.float32)
    depth[:known] = 50.0
    frame = Frame(0, 0, np.full((48, 64, 3), 90, np.uint8), depth=depth.reshape(48, 64))
    late, only = LateDepth.of(frame, "cpu", places=True), LateDepth.for_placement(frame, "cpu")
    if not known:
        assert late.possible is late.everywhere is only.possible is None
        return
    assert late.possible is not None and late.everywhere is not None and only.possible is not None
    assert int((late.possible > 0).sum()) == int((only.possible > 0).sum()) == known
    assert torch.allclose(late.everywhere, torch.tensor(50.0), rtol=1e-4)
    assert LateDepth.of(frame, "cpu").everywhere is None
