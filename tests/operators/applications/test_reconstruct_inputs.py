"""Inputs of an offline reconstruction are left out or estimated where validation frames are clearly better by that."""

from __future__ import annotations

import itertools
import json

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput, RecordingInvalid
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.poses import odometry
from gsplat_core.training import offline
from gsplat_core.training.metrics import psnr_tissue_db
from operators.applications import reconstruct as module
from operators.applications.evaluate import EvaluationSettings, evaluate
from operators.applications.evaluated import EvaluatedRun
from operators.applications.session import judged
from operators.metrics import QualityResult
from operators.pose import EstimatedPoses
from operators.sources.registry import SourceOptions, open_source
from services.reports.build import write_reports
from tests.gsplat_core.geometry.moving_scope import SIDEWAYS, video


@pytest.mark.parametrize(
    ("gain_db", "dropped"), [(2 * offline.INPUT_GAIN_DB, True), (0.5 * offline.INPUT_GAIN_DB, False)]
)
def test_depth_and_right_eye_are_left_out_if_validation_gains(tmp_path, monkeypatch, gain_db, dropped):
    """The scores of the validation frames are the test's; each input that is left out gains the same."""
    folder = synthesize(tmp_path / "take", frames=8, width_px=40, height_px=32)
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    monkeypatch.setattr(offline, "MOST_STEPS", 1)

    def score(learned, frames):
        without = (learned.snapshot().depth_source is None) + (learned.config.eyes == "left")
        return 30.0 + gain_db * without

    monkeypatch.setattr(module, "validation_psnr_db", score)
    settings = module.ReconstructSettings(recording=folder, out=tmp_path / "out", sinks=(), eyes="both")
    outcome = module.reconstruct(settings, clock=lambda: 0.0, report=write_reports)
    assert any("depth was not used" in note for note in outcome.notes) == dropped
    assert any("right eye was not used" in note for note in outcome.notes) == dropped
    run = json.loads((tmp_path / "out" / "report.json").read_text())["run"]
    assert run["eyes"] == ("left" if dropped else "both")


@pytest.mark.parametrize(("trial_s", "tried"), [(9, ["depth", "right eye"]), (13, ["depth"]), (19, [])])
def test_other_inputs_are_tried_until_share_of_time_limit(tmp_path, monkeypatch, trial_s, tried):
    """Each trial takes the test's time, of a limit of 60 s."""
    folder = synthesize(tmp_path / "take", frames=8, width_px=40, height_px=32)
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    monkeypatch.setattr(offline, "MOST_STEPS", 1)
    now_s = 0.0

    def score(learned, frames):
        nonlocal now_s
        now_s += trial_s
        return 30.0 + (learned.snapshot().depth_source is None) + (learned.config.eyes == "left")

    monkeypatch.setattr(module, "validation_psnr_db", score)
    settings = module.ReconstructSettings(recording=folder, out=tmp_path / "out", sinks=(), eyes="both", minutes=1.0)
    outcome = module.reconstruct(settings, clock=lambda: now_s)
    assert [
        name for name in ("depth", "right eye") if any(f"{name} was not used" in note for note in outcome.notes)
    ] == tried


@pytest.fixture
def moving(tmp_path):
    """Folder with pictures of a moving scope, without poses."""
    folder = tmp_path / "take"
    folder.mkdir()
    for number, frame in enumerate(video(12, SIDEWAYS)[0]):
        cv2.imwrite(str(folder / f"{number:03}.png"), cv2.resize(frame.image[..., ::-1], (80, 64)))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("gain_db", "kept"), [(2 * offline.INPUT_GAIN_DB, True), (0.5 * offline.INPUT_GAIN_DB, False)])
def test_estimated_poses_are_used_if_validation_gains(moving, tmp_path, monkeypatch, gain_db, kept):
    """The scores of the validation frames are the test's; estimated poses gain."""
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    monkeypatch.setattr(offline, "MOST_STEPS", 1)
    monkeypatch.setattr(
        module, "validation_psnr_db", lambda learned, frames: 30.0 + gain_db * (frames[0].pose is not None)
    )
    settings = module.ReconstructSettings(recording=moving, out=tmp_path / "out", sinks=())
    outcome = module.reconstruct(settings, clock=lambda: 0.0)
    assert any("the scope moves" in note for note in outcome.notes) == kept
    assert ("poses" in outcome.outputs) == kept
    if kept:
        places = np.load(outcome.outputs["poses"])[:, :3, 3]
        assert places.shape == (12, 3) and np.linalg.norm(places[-1]) > 5 * np.linalg.norm(places[1])


@pytest.mark.slow
def test_reason_for_missing_path_is_noted_and_training_continues(moving, tmp_path, monkeypatch):
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    monkeypatch.setattr(offline, "MOST_STEPS", 1)

    def refused(frames, camera, after_frame, while_refining):
        raise InvalidInput("only 3 observations")

    monkeypatch.setattr(module, "camera_path_of", refused)
    settings = module.ReconstructSettings(recording=moving, out=tmp_path / "out", sinks=())
    outcome = module.reconstruct(settings, clock=lambda: 0.0)
    assert "no poses of the scope were estimated: only 3 observations" in outcome.notes
    assert "poses" not in outcome.outputs and outcome.find(QualityResult).held_out.means()["psnr_tissue_db"] > 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("trial_s", "frame_s", "refined_s", "tracked"),
    [
        (5.0, 1.0, 4.0, 10),  # the trial with poses is expected to end after 24 of 36 s
        (5.0, 1.0, 30.0, 10),  # refinement took too long
        (5.0, 1.9, 0.0, 1),  # expected to end after 5 + 10 * 1.9 / 0.7 + 5 s
        (19.0, 0.0, 0.0, 1),
    ],
)
def test_poses_are_tried_if_trial_is_expected_to_end_in_time(
    moving, tmp_path, monkeypatch, trial_s, frame_s, refined_s, tracked
):
    """The clock of the test counts `trial_s` for each trial and `frame_s` for each tracked frame. The limit is 60 s."""
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    monkeypatch.setattr(offline, "MOST_STEPS", 1)
    now_s, scored, done = 0.0, [], 0
    estimate = module.camera_path_of

    def timed(frames, camera, after_frame, while_refining):
        nonlocal now_s

        def count():
            nonlocal now_s, done
            now_s += frame_s
            done += 1
            after_frame()

        path = estimate(frames, camera, count, while_refining)
        now_s += refined_s
        return path

    def score(learned, frames):
        nonlocal now_s
        now_s += trial_s
        scored.append(frames[0].pose is not None)
        return 30.0

    monkeypatch.setattr(module, "camera_path_of", timed)
    monkeypatch.setattr(module, "validation_psnr_db", score)
    settings = module.ReconstructSettings(recording=moving, out=tmp_path / "out", sinks=(), minutes=1.0)
    shown = []
    outcome = module.reconstruct(settings, progress=lambda each: shown.append(each), clock=lambda: now_s)
    expected = tracked == 10 and refined_s < 10
    assert done == tracked and any(scored) == expected
    assert [each.done for each in shown if each.stage == "poses"] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 9][:tracked]
    assert any("no time to try estimated poses; --minutes raises it" in note for note in outcome.notes) != expected


@pytest.mark.slow
def test_stop_request_ends_estimation_of_path(moving, tmp_path, monkeypatch):
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    tracked = 0

    def noted(each):
        nonlocal tracked
        tracked += each.stage == "poses"

    settings = module.ReconstructSettings(recording=moving, out=tmp_path / "out", sinks=())
    outcome = module.reconstruct(settings, progress=noted, stop_requested=lambda: tracked > 2, clock=lambda: 0.0)
    assert tracked == 3 and outcome.interrupted and "poses" not in outcome.outputs
    assert outcome.find(offline.ChosenSteps) == offline.ChosenSteps(1, (), "interrupted")
    assert not any("estimated poses" in note for note in outcome.notes), outcome.notes


@pytest.mark.slow
def test_stop_request_ends_estimation_of_requested_poses(moving, tmp_path):
    tracked = 0

    def noted(each):
        nonlocal tracked
        tracked += each.stage == "poses"

    settings = module.ReconstructSettings(recording=moving, out=tmp_path / "out", sinks=(), poses="estimated")
    outcome = module.reconstruct(settings, steps=9, progress=noted, stop_requested=lambda: tracked > 2)
    assert tracked == 3 and outcome.interrupted and "poses" not in outcome.outputs
    assert any("interrupted after 1 of 9 training steps" in note for note in outcome.notes)
    assert "the estimation of poses was interrupted: the model has none" in outcome.notes


@pytest.mark.slow
@pytest.mark.parametrize("poses", ["estimated", None])
def test_stop_request_ends_refinement_of_path(moving, tmp_path, monkeypatch, poses):
    """The request comes while the pose of the fourth frame is estimated from the tracks of all ten."""
    monkeypatch.setattr(offline, "FIRST_STEPS", 1)
    placed = []
    place = odometry._Odometry._place

    def counted(self, frame):
        placed.append(frame)
        return place(self, frame)

    monkeypatch.setattr(odometry._Odometry, "_place", counted)
    settings = module.ReconstructSettings(
        recording=moving, out=tmp_path / "out", sinks=(), **{"poses": poses} if poses else {}
    )
    outcome = module.reconstruct(settings, stop_requested=lambda: 3 in placed, clock=lambda: 0.0)
    assert placed and max(placed) <= 4, placed
    assert outcome.interrupted and "poses" not in outcome.outputs
    assert any("poses was interrupted" in note for note in outcome.notes) == (poses == "estimated")


@pytest.mark.slow
def test_requested_poses_are_estimated_once_and_used_by_evaluation(moving, tmp_path):
    """Its evaluation uses them too."""
    out = tmp_path / "out"
    settings = module.ReconstructSettings(recording=moving, out=out, sinks=(), poses="estimated")
    outcome = module.reconstruct(settings, steps=1)
    assert outcome.find(EstimatedPoses) is None, "poses were estimated again, frame by frame"
    run = EvaluatedRun(out, "reconstruct", "basis", seed=0, steps_per_frame=None, scale=1.0, heldout=True)

    def heldout_db():
        wanted = EvaluationSettings(moving, ("heldout",))
        found = evaluate(load_bundle(out / "model"), run, wanted, tmp_path).heldout
        assert found is not None
        return found.score.psnr_tissue_db

    assert heldout_db() == pytest.approx(outcome.find(QualityResult).held_out.means()["psnr_tissue_db"], abs=0.05)
    outcome.outputs["poses"].write_bytes(b"no poses")
    with pytest.raises(RecordingInvalid, match="has no poses"):
        heldout_db()


def test_surround_of_round_view_is_neither_trained_on_nor_scored(tmp_path):
    size = height, width = 64, 80
    y, x = np.mgrid[:height, :width]
    inside = (x - 40) ** 2 + (y - 32) ** 2 <= 28**2
    folder = tmp_path / "take"
    folder.mkdir()
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(90, 220, (16, 20, 3), np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    for number in range(10):
        shown = np.where(inside[..., None], np.roll(texture, number % 3, 1), 8)
        cv2.imwrite(str(folder / f"{number:03}.png"), shown.astype(np.uint8))
    settings = module.ReconstructSettings(recording=folder, out=tmp_path / "out", sinks=())
    outcome = module.reconstruct(settings, steps=30)
    source = open_source(folder, SourceOptions())
    kept = judged(source)._seen
    assert kept.shape == size and not (kept.astype(bool) & ~inside).any() and kept.mean() > 0.8 * inside.mean()
    model = load_bundle(outcome.outputs["model"])
    where = model.camera.K @ model.gaussians.means.double().numpy().T
    column, row = np.rint(where[:2] / where[2]).astype(int)
    opaque = torch.sigmoid(model.gaussians.logit_opacities).numpy() > 0.5
    outside = np.hypot(column - 40, row - 32) > 36
    assert len(opaque) > 500 and not opaque[outside].any() and opaque[~outside].mean() > 0.8
    pictures = [frame.image for frame in open_recording(folder)]
    copies = [psnr_tissue_db(a, b, kept) for a, b in itertools.pairwise(pictures)]
    assert outcome.find(QualityResult).previous_frame_db == pytest.approx(np.mean(copies), abs=0.01)
