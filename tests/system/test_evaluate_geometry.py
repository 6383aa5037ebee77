"""`intrasplat evaluate --protocol geometry` scores exactly the ground truth that a recording has."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.calibration import write_poses
from gsplat_core.io.recordings.synthetic.scene import Extras
from services.cli.app import run
from services.reports.evaluation import EvaluationReport


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Path:
    """Nine frames of a moving scope with all kinds of ground truth."""
    extras = Extras(third=True, tracks=True, flow=True)
    folder = tmp_path_factory.mktemp("known") / "known"
    return synthesize(folder, frames=9, fps=9, width_px=64, height_px=48, camera="moving", extras=extras)


@pytest.fixture(scope="module")
def made(known, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("outputs") / "run"
    assert run(["reconstruct", str(known), "--out", str(out), "--steps", "30"]) == 0
    return out


def geometry(intrasplat, *arguments):
    done = intrasplat("evaluate", *arguments, "--protocol", "geometry", "--json")
    assert done.code == 0, done.err
    found = EvaluationReport.model_validate_json(done.out).geometry
    assert found is not None
    return found


def test_geometry_measures_all_known_ground_truth(intrasplat, known, made):
    found = geometry(intrasplat, made, known)
    assert found.frames == 9 and found.depth is not None and found.normals is not None and found.parts is not None
    assert 0 < found.depth.scaled_rmse_share < 0.2 and found.depth.plane_rmse_share < found.depth.level_rmse_share
    assert {view.name for view in found.views} == {"right", "third"}
    assert found.tracking is not None and found.tracking.compared > 100
    assert found.flow is not None and found.flow.frames == 8 and found.flow.still.mean_mm is not None
    assert found.trajectory is None  # the model has the recording's own poses


def test_geometry_is_printed_and_written_with_baselines(intrasplat, known, made, tmp_path):
    out = tmp_path / "out"
    done = intrasplat("evaluate", made, known, "--protocol", "geometry", "--out", out)
    assert done.code == 0, done.err
    for said in (
        "Depth after one scale",
        "best-fit plane",
        "View of the third camera",
        "left picture",
        "no motion",
        "Scene flow",
    ):
        assert said in done.out
    page = (out / "evaluation.html").read_text()
    assert "In three dimensions" in page and "relative" in page and "absolute" in page
    assert json.loads((out / "evaluation.json").read_text())["geometry"]["depth"]["frames"] == 9


def test_geometry_poses_option_scores_trajectory(intrasplat, known, made, tmp_path):
    """Halved translations give the trajectory a wrong scale and the model a wrong place."""
    recording = open_recording(known)
    poses = np.stack([recording.camera_at(k).world_to_camera for k in range(9)])
    halved = poses.copy()
    halved[:, :3, 3] *= 0.5
    write_poses(tmp_path / "poses.npy", halved)
    found = geometry(intrasplat, made, known, "--poses", tmp_path / "poses.npy")
    assert found.trajectory is not None and found.trajectory.scale == pytest.approx(2)
    assert found.trajectory.similarity_share < 1e-6
    assert found.trajectory.rigid_share == pytest.approx(found.trajectory.still_share / 2)
    (tmp_path / "poses.npy").write_bytes(b"no poses")
    done = intrasplat("evaluate", made, known, "--protocol", "geometry", "--poses", tmp_path / "poses.npy")
    assert done.code == 2 and "poses.npy" in done.err


def test_geometry_without_ground_truth_has_no_depth_or_tracking(intrasplat, tmp_path):
    folder = synthesize(tmp_path / "plain", frames=3, fps=3, width_px=48, height_px=40, stereo=False)
    for path in (folder / "depth").iterdir():
        path.unlink()
    (folder / "depth").rmdir()
    assert run(["reconstruct", str(folder), "--out", str(tmp_path / "run"), "--steps", "5"]) == 0
    found = geometry(intrasplat, tmp_path / "run", folder)
    assert found.depth is None and found.tracking is None and found.views == [] and found.parts is not None


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    """A recording of three frames in `x` and its model in `run`; not to be changed."""
    folder = tmp_path_factory.mktemp("small")
    extras = Extras(third=True, tracks=True, flow=True)
    synthesize(folder / "x", frames=3, fps=3, width_px=48, height_px=40, stereo=False, extras=extras)
    assert run(["reconstruct", str(folder / "x"), "--out", str(folder / "run"), "--steps", "5"]) == 0
    return folder


@pytest.mark.parametrize(
    ("break_it", "said"),
    [
        (lambda folder: (folder / "views.json").write_text("{}"), "views.json"),
        (lambda folder: next((folder / "views/third/images").iterdir()).unlink(), "views/third"),
        (lambda folder: np.save(folder / "tracks_seen.npy", np.ones((3, 5), np.uint8)), "tracks_seen.npy"),
        (
            lambda folder: (folder / "flow/000000.npy").unlink() or (folder / "flow/000001.npy").unlink(),
            "1 files for 3",
        ),
        (
            lambda folder: np.save(folder / "flow/000001.npy", np.zeros((40, 48), np.float32)),
            "000001.npy: it is [40, 48]",
        ),
        (lambda folder: np.save(folder / "flow/000001.npy", np.zeros((40, 40, 2), np.float32)), "the frame 48x40"),
        (lambda folder: (folder / "scene_flow/000000.npy").write_bytes(b"no"), "000000.npy"),
        (lambda folder: np.save(folder / "tracks.npy", np.full((3, 63, 3), np.nan, np.float32)), "finite"),
    ],
)
def test_geometry_refuses_unreadable_ground_truth(intrasplat, small, tmp_path, break_it, said):
    folder = shutil.copytree(small / "x", tmp_path / "x")
    break_it(folder)
    done = intrasplat("evaluate", small / "run", folder, "--protocol", "geometry")
    assert done.code == 2 and said in done.err
