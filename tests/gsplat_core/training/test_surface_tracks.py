"""Trajectories of the surface through a recording, against what the generator of the recording knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.image_motion import Seen
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.offline import SurfaceDepth, SurfaceTracks, between_known, steady_course
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.step import TrainingStep

FRAMES, FPS = 12, 8.0
ASKED = RenderSettings(FRAMES, 192, 160, FPS, seed=1)
MOVING = replace(ASKED, camera="moving")


@pytest.fixture(scope="module")
def fixed():
    return render_recording(ASKED)


@pytest.fixture(scope="module")
def moving():
    return render_recording(MOVING)


def observations(recording) -> list[Observation]:
    return [Observation.of(frame, recording.camera) for frame in recording]


def points_of(asked: RenderSettings) -> torch.Tensor:
    """Return the generator's grid of tissue points in each frame [T, P, 3]."""
    moves = asked.camera == "moving"
    scene = SyntheticScene.from_seed(asked.seed, asked.width_px, asked.height_px, asked.frames / asked.fps, moves)
    return torch.from_numpy(np.stack([scene.track(number / asked.fps) for number in range(asked.frames)]))


def seen_throughout(recording, points: torch.Tensor) -> torch.Tensor:
    """Return True for points that all frames show well inside the picture and off the tool [P]."""
    shown = torch.ones(points.shape[1], dtype=torch.bool)
    for frame, here in zip(recording, points, strict=True):
        seen = Seen(recording.camera.with_pose(frame.pose), here)
        x, y = seen.pixels.long().unbind(1)
        inside = (x > 8) & (y > 8) & (x < recording.width_px - 8) & (y < recording.height_px - 8)
        tissue = torch.from_numpy(frame.mask)[y.clamp(0, recording.height_px - 1), x.clamp(0, recording.width_px - 1)]
        shown &= inside & (tissue > 0)
    return shown


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 5, FRAMES - 1])
@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_surface_tracks_follow_true_tissue_points(request, camera, number):
    recording, true = request.getfixturevalue(camera), points_of(ASKED if camera == "fixed" else MOVING)
    chosen = seen_throughout(recording, true)
    assert chosen.sum() > 12
    found = SurfaceTracks(list(recording), observations(recording)).trajectories(true[number][chosen], number)
    off = (found - true[:, chosen].transpose(0, 1)).norm(dim=2)
    moved = (true - true[number]).norm(dim=2)[:, chosen]
    assert moved.median() > 0.8, "millimetres"
    assert off.median() < 0.25 and off.quantile(0.9) < 0.8


def test_surface_tracks_behind_tool_follow_surroundings(fixed):
    frames, true = list(fixed), points_of(ASKED)
    chosen = seen_throughout(fixed, true)
    # A tool that covers everything but the edges for half of the time.
    hidden = [
        frame.with_fields(mask=covered(frame.mask)) if 3 <= frame.seq < 9 else frame for frame in frames
    ]  # fmt: skip
    found = SurfaceTracks(hidden, [Observation.of(frame, fixed.camera) for frame in hidden]).trajectories(
        true[0][chosen], 0
    )
    off = (found - true[:, chosen].transpose(0, 1)).norm(dim=2)
    still = (true - true[0]).norm(dim=2)[:, chosen]
    assert off[:, 3:9].median() < 0.6 * still.T[:, 3:9].median()


def covered(mask: np.ndarray) -> np.ndarray:
    mask = mask.copy()
    mask[40:120, 50:140] = 0
    return mask


@pytest.mark.parametrize(
    "fields",
    [
        {"depth": None},
        {"depth_origin": DEPTH_ORIGINS["light"]},
        {"depth_origin": DEPTH_ORIGINS["learned"]},
        {"depth_confidence": np.full((ASKED.height_px, ASKED.width_px), 0.1, np.float32)},
    ],
    ids=["none", "light", "learned", "not believed"],
)
def test_surface_tracks_without_depth_move_across_picture_only(fixed, fields):
    frames = [frame.with_fields(**fields) for frame in fixed]
    points = torch.tensor([[0.0, 0.0, 60.0], [10.0, -8.0, 60.0]])
    moved = SurfaceTracks(frames, [Observation.of(frame, fixed.camera) for frame in frames]).trajectories(points, 0)
    assert torch.equal(moved[..., 2], torch.full_like(moved[..., 2], 60.0))
    assert moves_before_the_first_step(fixed.camera, frames)


def test_single_frame_gives_no_initial_motion(fixed):
    assert not moves_before_the_first_step(fixed.camera, list(fixed)[:1])


def test_frames_with_depth_give_initial_motion(fixed):
    assert moves_before_the_first_step(fixed.camera, list(fixed))


def moves_before_the_first_step(camera, frames: list[Frame], **shows) -> bool:
    seen = [Observation.of(frame, camera) for frame in frames]
    gaussians = gaussians_from_frame(frames[0], camera, 200, sh_degree=0, default_depth_mm=60.0)
    field = BasisField(gaussians.count, (0.0, 2.0), bumps=12)
    step = TrainingStep(gaussians, field, ReconstructorConfig(field="basis", gaussians=200), camera)
    SurfaceTracks(frames, seen, **shows).apply(step, 0, 0)
    return bool(field.weights.any())


def test_between_known_interpolates_known_values():
    values = torch.tensor([[0.0, 2, 0, 0, 8, 0], [0, 0, 0, 0, 0, 0], [5, 0, 0, 0, 0, 0]])
    otherwise = torch.full_like(values, 3.0)
    times = torch.tensor([0.0, 1, 2, 3, 4, 5])
    expected = torch.tensor([[2.0, 2, 4, 6, 8, 8], [3] * 6, [5] * 6])
    torch.testing.assert_close(between_known(values, otherwise, times), expected)


@pytest.mark.slow
def test_offline_model_has_motion_along_line_of_sight_after_few_steps(fixed):
    """Steps alone would not learn this motion, since positions move by hundredths of a pixel in a step."""
    config = replace(ReconstructorConfig.offline(), gaussians=1500, max_gaussians=2000)
    learner = Reconstructor(config, fixed.camera)
    learner.fit(list(fixed), 24)
    model = learner.snapshot()
    errors, at_rest = [], []
    first = next(iter(fixed))
    for frame in fixed:
        shown = render(model.at(frame.time_s), fixed.camera, depth=True).depth.numpy()
        both = (frame.mask > 0) & (first.mask > 0)
        errors.append(error_of(shown, frame, both))
        at_rest.append(error_of(first.depth, frame, both))
    assert np.mean(errors) < 0.4 * np.mean(at_rest)


def error_of(depth: np.ndarray, frame: Frame, where: np.ndarray) -> float:
    return float(np.sqrt(np.square(depth - frame.depth)[where].mean()))


def test_surface_tracks_at_rest_ignore_fluctuating_depth(moving):
    factors = torch.linspace(0.7, 1.4, FRAMES).tolist()
    uncertain = [frame.with_fields(depth=frame.depth * factors[frame.seq]) for frame in moving]
    seen = [Observation.of(frame, moving.camera) for frame in uncertain]
    points = points_of(MOVING)[5][::7].float()
    found = SurfaceTracks(uncertain, seen, at_rest=True).trajectories(points, 5)
    distance = lambda places, number: Seen(seen[number].camera, places).depth
    for number in (0, FRAMES - 1):
        share = distance(found[:, number], number) / distance(points, number)
        assert (share - 1).abs().max() < 0.05
    assert (found - points[:, None]).norm(dim=2)[:, [0, FRAMES - 1]].median() > 0.2, (
        "across the picture they go with the flow"
    )


def test_steady_course_equals_wiener_filter_reference():
    """Compared with a scalar computation in float64 of a Wiener filter towards the median."""
    times = torch.tensor([0.0, 1.0, 1.5, 4.0, 5.0, 9.0, 9.5], dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    smooth = 1 + 0.1 * torch.linspace(0, 1, 7, dtype=torch.float64)
    values = smooth + torch.tensor([[0.0], [0.01], [0.05]]) * torch.randn(3, 7, generator=random, dtype=torch.float64)
    found = steady_course(values, times)
    for row, out in zip(values.tolist(), found.tolist(), strict=True):
        middle, noise = sorted(row)[3], []
        for k in range(1, 6):
            share = float((times[k] - times[k - 1]) / (times[k + 1] - times[k - 1]))
            between = (1 - share) * row[k - 1] + share * row[k + 1]
            noise.append((row[k] - between) ** 2 / (1 + share**2 + (1 - share) ** 2))
        variation = sum((value - middle) ** 2 for value in row) / 7
        kept = min(1.0, max(0.0, 1 - sum(noise) / 5 / variation))
        assert out == pytest.approx([middle + kept * (value - middle) for value in row])


def test_surface_depth_interpolates_except_beside_holes():
    depth = np.tile(np.linspace(40, 60, 21, dtype=np.float32), (15, 1))
    depth[7, 10] = 0
    found = SurfaceDepth.of(depth, torch.device("cpu"))
    pixels = torch.tensor([[3.5, 3.5], [4.0, 3.5], [16.25, 11.0], [10.5, 7.5], [9.0, 7.5], [11.8, 8.6]])
    smooth, ratio = found.at(pixels)
    torch.testing.assert_close((smooth * ratio)[:3], torch.tensor([43.0, 43.5, 55.75]))
    assert ratio[3:].tolist() == [0, 0, 0] and (smooth[3:] - pixels[3:, 0] - 39.5).abs().max() < 1
    assert SurfaceDepth.of(np.full((4, 5), np.nan, np.float32), torch.device("cpu")) is None
