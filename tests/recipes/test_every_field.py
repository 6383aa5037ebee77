"""Every registered field runs in every command that makes or reads a model; so does one that only the tests know."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.deformation import FIELDS
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from gsplat_core.training.upkeep import RENEW_EVERY
from services.cli.app import run
from tests.recipes.test_deformation_field import DRIFT, POLYNOMIAL

TEST_ONLY = {kind.name: kind for kind in (DRIFT, POLYNOMIAL)}
EACH_FIELD = pytest.mark.parametrize("field", [*{FIELDS[name].name: None for name in FIELDS}, *TEST_ONLY])


@pytest.fixture(autouse=True)
def test_only_fields():
    """Register the fields of the tests for the time of one."""
    for name, kind in TEST_ONLY.items():
        FIELDS.add(name, kind)
    yield
    for name in TEST_ONLY:
        FIELDS.remove(name)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "moving"
    return synthesize(folder, frames=10, fps=20, width_px=48, height_px=36, stereo=False)


def reported(capsys, *arguments: object) -> dict:
    """Run a command with --json, which must end well; return its report."""
    capsys.readouterr()
    code = run([*map(str, arguments), "--json"])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out)


@pytest.mark.slow
@EACH_FIELD
@pytest.mark.parametrize(
    "command", [("live", "--scale", 1), ("replay", "--steps-per-frame", 2), ("reconstruct", "--steps", 8)]
)
def test_a_command_that_makes_a_model_takes_the_field(recording, tmp_path, capsys, field, command):
    name, *options = command
    folder = tmp_path / "out"
    reported(capsys, name, recording, "--out", folder, "--field", field, *options)
    assert load_bundle(folder / "model").field.kind == FIELDS[field].name


@pytest.mark.slow
@EACH_FIELD
def test_a_command_that_reads_a_model_takes_the_field(recording, tmp_path, capsys, field):
    folder = tmp_path / "out"
    reported(capsys, "replay", recording, "--out", folder, "--field", field, "--steps-per-frame", 1)
    reported(capsys, "evaluate", folder, recording)
    reported(capsys, "evaluate", folder, recording, "--protocol", "causal", "--steps-per-frame", 1, "--max-frames", 4)
    assert run(["render", str(folder / "model"), "--out", str(tmp_path / "pictures"), "--fps", "10"]) == 0
    assert list((tmp_path / "pictures").glob("*.png"))
    for file in ("scene.ply", "scene.splat", "scene.glb"):
        assert run(["export", str(folder / "model"), str(tmp_path / file)]) == 0
        assert (tmp_path / file).stat().st_size > 1000


@EACH_FIELD
def test_everything_that_a_live_scene_goes_through_takes_the_field(recording, field):
    """Late depth, upkeep, growth, rehearsal, a cut and the way back to a place that was left."""
    opened = open_recording(recording)
    frames, camera = list(opened), opened.camera
    config = ReconstructorConfig(
        field=field, gaussians=200, max_gaussians=300, history_s=0.5, preallocate=True, motion_prior="flow",
        start_from_motion=True, squared_error=True,
    )  # fmt: skip
    made = Reconstructor(config, camera, live=LiveTraining(colour_relaxation=1.0))
    for k, frame in enumerate(frames):
        frame = frame.with_fields(depth=None)
        if k in (5, 8):
            made.begin_scene(frame)
        made.observe(frame, budget=Budget.of_steps(30 if k in (0, 5, 8) else 4))
        made.publish()
        depth = np.full(frame.image.shape[:2], 55.0, np.float32)
        made.take_depth(frame.with_fields(depth=depth, depth_origin=DEPTH_ORIGINS["stereo"]))
        made.grow(frame)
        made.rehearse(2)
    counted = made._step.steps
    made._step._adam.steps += RENEW_EVERY
    made.grow(frame)
    made._step._adam.steps = counted
    made.grow_once()
    made.rehearse(8)
    image = made.publish().render(frame.time_s, camera.with_pose(frame.pose)).image.clamp(0, 1)
    assert psnr_tissue_db((image * 255).round().byte().numpy(), frame.image, frame.mask) > 18
