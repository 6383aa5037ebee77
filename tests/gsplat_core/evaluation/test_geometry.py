"""Models whose errors are known, measured in three dimensions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsplat_core.evaluation.geometry import Geometry, evaluate_geometry
from gsplat_core.evaluation.protocols import PictureMaker
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.scene import Extras, SyntheticScene
from gsplat_core.io.recordings.truth import open_truth
from tests.gsplat_core.evaluation.true_model import true_model

FRAMES, FPS = 5, 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    extras = Extras(third=True, tracks=True, flow=True)
    path = tmp_path_factory.mktemp("geometry") / "recording"
    return synthesize(path, frames=FRAMES, fps=FPS, width_px=96, height_px=72, seed=3, stereo=True, extras=extras)


def measured(folder: Path, moving: bool = False, **model: object) -> Geometry:
    recording = open_recording(folder)
    scene = SyntheticScene.from_seed(3, 96, 72, FRAMES / FPS, moving)
    made = true_model(scene, FRAMES / FPS, **model)  # type: ignore[arg-type]
    pictures = PictureMaker(recording.camera, ray_depth=True)
    return evaluate_geometry(
        recording,
        recording.frame_count,
        recording.camera,
        made,
        lambda camera, frame: pictures(made, frame.with_fields(pose=camera.world_to_camera)),
        open_truth(folder, recording.frame_count),
    )


@pytest.fixture(scope="module")
def right(folder: Path) -> Geometry:
    return measured(folder)


@pytest.mark.slow
def test_geometry_of_true_model_has_small_errors(right: Geometry) -> None:
    assert right.frames == FRAMES
    assert right.depth is not None and right.normals is not None and right.tracking is not None
    assert right.depth.rmse_share < 0.006 and right.depth.scale == pytest.approx(1, abs=3e-3)
    assert right.depth.rmse_share < 0.3 * right.depth.plane_rmse_share < 0.3 * right.depth.level_rmse_share
    assert right.normals.mean_deg < 0.5 * right.normals.plane_mean_deg
    assert right.tracking.points > 20 and right.tracking.compared > 60
    assert right.tracking.model.median_mm < 0.3 and right.tracking.model.median_px < 0.3
    assert right.tracking.still.median_mm > 1.0
    assert right.tracking.model.within_mm > right.tracking.still.within_mm
    assert right.scaled_views == right.views  # no scale is missing


def test_geometry_measures_ray_depth(right: Geometry) -> None:
    assert right.depth is not None and right.ray_depth is not None
    assert right.normals is not None and right.ray_normals is not None
    assert right.ray_depth.plane_rmse_share == pytest.approx(right.depth.plane_rmse_share, rel=0.02)
    assert right.ray_depth.rmse_share < 0.006 and right.ray_normals.mean_deg < 0.5 * right.ray_normals.plane_mean_deg


def test_geometry_flow_of_true_model_matches_tissue_motion(right: Geometry, folder: Path) -> None:
    assert right.flow is not None and right.flow.frames == FRAMES - 1  # nothing comes after the last one
    model, still = right.flow.model, right.flow.still
    assert model.median_px < 0.1 < 0.5 < still.median_px
    assert model.median_mm is not None and still.median_mm is not None
    assert model.median_mm < 0.1 * still.median_mm
    lengths = [np.linalg.norm(np.load(folder / "scene_flow" / f"{k:06d}.npy"), axis=2) for k in range(FRAMES - 1)]
    assert still.mean_mm == pytest.approx(np.nanmean(lengths), rel=0.05)


@pytest.mark.slow
def test_geometry_scope_motion_in_flow_but_not_in_scene_flow(tmp_path: Path) -> None:
    size = {"width_px": 96, "height_px": 72}
    extras = Extras(flow=True)
    folder = synthesize(
        tmp_path / "x", frames=FRAMES, fps=FPS, seed=3, stereo=False, camera="moving", extras=extras, **size
    )
    found = measured(folder, moving=True)
    assert found.flow is not None
    model, still = found.flow.model, found.flow.still
    assert model.median_px < 0.15 * still.median_px
    assert model.median_mm is not None and still.median_mm is not None
    assert model.median_mm < 0.1 * still.median_mm


def test_geometry_scores_further_views_beside_left_image(right: Geometry) -> None:
    views = {view.name: view for view in right.views}
    assert set(views) == {"right", "third"}
    for view in views.values():
        model, left, shifted = (score.psnr_tissue_db for score in (view.model, view.left, view.shifted))
        assert model is not None and left is not None and shifted is not None
        # The model's colours are those of time 0, highlights and all, and blurred: it is no match for a newer picture.
        assert left + 2 < shifted and model > 24
        assert view.model.frames == FRAMES and 0.5 < view.seen < 1


@pytest.mark.slow
def test_geometry_of_unscaled_model_correct_after_one_factor(folder: Path, right: Geometry) -> None:
    small = measured(folder, shrink=2.0)
    assert small.depth is not None and right.depth is not None
    assert small.tracking is not None and right.tracking is not None
    assert small.depth.scale == pytest.approx(2, rel=3e-3)
    assert small.depth.rmse_share == pytest.approx(0.5, abs=0.02)
    assert small.depth.scaled_rmse_share == pytest.approx(right.depth.scaled_rmse_share, abs=5e-4)
    assert small.tracking.model.median_mm > 20
    assert small.tracking.scaled.median_mm == pytest.approx(right.tracking.scaled.median_mm, abs=0.02)
    assert small.flow is not None and right.flow is not None
    assert small.flow.model.median_px == pytest.approx(right.flow.model.median_px, abs=0.01)  # a picture knows no scale
    assert small.flow.model.median_mm == pytest.approx(0.5 * right.flow.still.median_mm, rel=0.1)
    assert small.flow.scaled.median_mm == pytest.approx(right.flow.model.median_mm, abs=0.01)
    for scaled, as_it_is, exact in zip(small.scaled_views, small.views, right.views, strict=True):
        assert scaled.model.psnr_tissue_db == pytest.approx(exact.model.psnr_tissue_db, abs=0.3)
        assert as_it_is.model.psnr_tissue_db is not None and scaled.model.psnr_tissue_db is not None
        assert as_it_is.model.psnr_tissue_db < scaled.model.psnr_tissue_db - 2


def test_geometry_of_static_model_equals_no_motion_baseline(folder: Path) -> None:
    still = measured(folder, moves=False)
    assert still.tracking is not None
    assert still.tracking.model.median_mm == pytest.approx(still.tracking.still.median_mm, rel=0.1)
    assert still.flow is not None and still.flow.model == still.flow.scaled
    assert still.flow.model.median_px == pytest.approx(still.flow.still.median_px, abs=1e-4)
    assert still.flow.model.mean_mm == pytest.approx(still.flow.still.mean_mm, abs=1e-5)


def test_geometry_is_deterministic(folder: Path, right: Geometry) -> None:
    assert measured(folder) == right


def test_geometry_without_ground_truth_is_none(tmp_path: Path) -> None:
    """A recording without ground truth has no figures."""
    folder = synthesize(tmp_path / "plain", frames=2, fps=2, width_px=48, height_px=40, stereo=False)
    recording = open_recording(folder)
    bare = [frame.with_fields(depth=None, depth_origin=None) for frame in recording]
    made = true_model(SyntheticScene.from_seed(0, 48, 40, 1.0, False), 1.0)
    pictures = PictureMaker(recording.camera)
    shown = lambda camera, frame: pictures(made, frame.with_fields(pose=camera.world_to_camera))
    found = evaluate_geometry(bare, 2, recording.camera, made, shown, open_truth(folder, 2))
    assert (found.depth, found.normals, found.views, found.tracking, found.flow) == (None, None, (), None, None)
    assert np.isfinite(found.frames) and found.frames == 2
