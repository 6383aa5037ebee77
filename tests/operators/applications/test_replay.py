"""The replay as a function: progress, stops, failures that carry what was reached, and no side effects on the caller."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidSetting, RecordingMissing
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording
from gsplat_core.scene.cameras import Camera
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.steps.step import TrainingStep
from operators import pipeline as pipeline_module
from operators.applications import replay as replay_module
from operators.applications.replay import ReplaySettings, replay
from operators.applications.session import RunOutcome
from operators.errors import DeviceMissing, OutputError, RunFailed, StorageFull
from operators.graph import MultiThreadScheduler
from operators.ingest import SourceResult
from operators.metrics import NextFrameResult, QualityResult
from operators.reconstruct import ModelResult
from operators.sinks.sink import KeyframesResult
from operators.sinks.video import DisplayResult
from operators.training import TrainingCounts


def ingested(outcome):
    return outcome.find(SourceResult).frames


def displayed(outcome):
    return outcome.find(DisplayResult).frames


def series(outcome):
    return outcome.find(QualityResult).series


def sha256(outcome):
    return outcome.find(QualityResult).frames_sha256


def model(outcome):
    return outcome.find(ModelResult).model


@pytest.fixture
def settings(tiny, tmp_path):
    return ReplaySettings(recording=tiny, out=tmp_path / "out", steps_per_frame=1)


def test_replay_reports_progress_for_each_displayed_frame(settings):
    events = []
    outcome = replay(settings, events.append)
    assert [(e.stage, e.done, e.total) for e in events] == [("replay", k, 4) for k in (0, 1, 2, 3, 4)]
    assert all(e.psnr_tissue_db > 20 for e in events[1:])
    assert (ingested(outcome), displayed(outcome), outcome.dropped) == (4, 4, 0)
    assert [entry["seq"] for entry in series(outcome)] == [0, 1, 2, 3]
    assert model(outcome).version == 4


def test_replay_shows_each_frame_with_model_trained_on_that_frame(settings):
    outcome = replay(settings)
    assert [entry["model_version"] for entry in series(outcome)] == [1, 2, 3, 4]


def test_replay_writes_outputs_on_stop_request(settings):
    shown = []
    outcome = replay(settings, shown.append, stop_requested=lambda: len(shown) > 2)
    assert outcome.interrupted and outcome.stop_reason == "interrupted"
    assert displayed(outcome) == ingested(outcome) == 2
    assert set(outcome.outputs) == {"video", "model", "frames"}


def test_stop_request_ends_training_of_first_frame(settings, monkeypatch):
    made = []
    make_step = TrainingStep.__call__
    monkeypatch.setattr(TrainingStep, "__call__", lambda *args: (made.append(1), make_step(*args))[1])
    outcome = replay(replace(settings, steps_per_frame=50), stop_requested=lambda: len(made) >= 2)
    assert outcome.interrupted and len(made) == 2 + displayed(outcome) - 1
    assert set(outcome.outputs) == {"video", "model", "frames"}


def test_replay_failure_carries_partial_outcome(settings):
    def fail_on_the_third(progress):
        if progress.done == 3:
            raise StorageFull("no room for progress")

    with pytest.raises(RunFailed, match="operator 'progress' failed in compute on frame 2") as caught:
        replay(settings, fail_on_the_third)
    outcome = caught.value.result
    assert isinstance(outcome, RunOutcome)
    assert displayed(outcome) == 3 and model(outcome).version == 3
    assert (settings.out / "reconstruction.mp4").exists() and (settings.out / "model").is_dir()


def test_replay_with_threads_matches_single_thread_byte_for_byte(settings, monkeypatch):
    expected = replay(settings)
    monkeypatch.setattr(pipeline_module, "scheduler_for", lambda device, app: MultiThreadScheduler(app))
    events = []
    outcome = replay(settings, events.append)
    assert [e.done for e in events] == [0, 1, 2, 3, 4]
    assert (displayed(outcome), outcome.dropped) == (4, 0)
    assert sha256(outcome) == sha256(expected)
    assert model(outcome).sha256() == model(expected).sha256()
    assert series(outcome) == series(expected)
    kept, wanted = outcome.find(KeyframesResult), expected.find(KeyframesResult)
    assert kept.worst_seq == wanted.worst_seq
    assert [k.rendered.frame.seq for k in kept.keyframes] == [k.rendered.frame.seq for k in wanted.keyframes]


def test_replay_failure_with_threads_carries_partial_outcome(settings, monkeypatch):
    monkeypatch.setattr(pipeline_module, "scheduler_for", lambda device, app: MultiThreadScheduler(app))

    def fail_on_the_second(progress):
        if progress.done == 2:
            raise StorageFull("no room for progress")

    with pytest.raises(RunFailed, match="operator 'progress' failed in compute on frame 1") as caught:
        replay(settings, fail_on_the_second)
    outcome = caught.value.result
    assert len(series(outcome)) >= 2 and displayed(outcome) >= 1 and model(outcome).version >= 2
    assert (settings.out / "reconstruction.mp4").exists() and (settings.out / "model").is_dir()


@pytest.mark.cuda
def test_replay_on_cuda_is_deterministic_and_close_to_cpu(gpu, settings):
    on_cpu = replay(settings)
    first, second = (replay(replace(settings, device="cuda", out=settings.out / name)) for name in "ab")
    assert sha256(first) == sha256(second)
    assert model(first).sha256() == model(second).sha256()
    assert model(first).gaussians.device.type == "cuda"
    assert (displayed(first), first.dropped, model(first).version) == (4, 0, 4)
    assert load_bundle(settings.out / "a" / "model").sha256() == model(first).sha256()
    expected = on_cpu.find(QualityResult).trained.means()["psnr_tissue_db"]
    assert first.find(QualityResult).trained.means()["psnr_tissue_db"] == pytest.approx(expected, abs=0.3)


def test_replay_keeps_global_random_state(settings):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    replay(settings)
    torch.testing.assert_close(torch.rand(3), expected, rtol=0, atol=0)


def test_replay_refuses_invalid_settings_before_output(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out = tmp_path / "out"
    for error, settings in (
        (RecordingMissing, {"recording": tmp_path / "nowhere"}),
        (DeviceMissing, {"device": "cuda"}),
        (InvalidSetting, {"steps_per_frame": 0}),
        (InvalidSetting, {"max_frames": 0}),
        (InvalidSetting, {"scale": 1e9}),
        (InvalidSetting, {"seed": 2**64}),
        (OutputError, {"out": tiny}),
    ):
        with pytest.raises(error):
            replay(ReplaySettings(**({"recording": tiny, "out": out} | settings)))
    assert not out.exists()


def test_gaussian_count_is_limited_by_frame_size(tiny, tmp_path):
    settings = ReplaySettings(tiny, tmp_path / "out")
    assert settings.reconstructor_config(64 * 48).gaussians == 64 * 48 // 4
    assert settings.reconstructor_config(640 * 512).gaussians == settings.reconstructor_config().gaussians


def test_offline_gaussian_count_is_limited_by_frame_size(tiny, tmp_path):
    settings = ReplaySettings(tiny, tmp_path / "out", field="hexplane")
    small = settings.reconstructor_config(64 * 48, offline=True)
    assert (small.gaussians, small.max_gaussians) == (64 * 48 // 4, 64 * 48 // 2)
    assert settings.reconstructor_config(1280 * 1024, offline=True) == ReconstructorConfig.offline("hexplane")


@pytest.mark.parametrize(("asked", "trained"), [(None, "left"), ("left", "left"), ("both", "both")])
def test_eyes_setting_defaults_to_left_eye(tiny, tmp_path, asked, trained):
    settings = ReplaySettings(tiny, tmp_path / "out", eyes=asked)
    assert settings.reconstructor_config().eyes == trained
    assert settings.reconstructor_config(offline=True).eyes == trained


def test_eyes_setting_refuses_unknown_value(tiny, tmp_path):
    with pytest.raises(InvalidSetting, match="eyes is 'right'"):
        ReplaySettings(tiny, tmp_path / "out", eyes="right")


def test_next_frame_score_matches_causal_protocol(settings):
    """Compare with the causal protocol, which renders through a separate path."""
    from gsplat_core.evaluation.protocols import PictureMaker, evaluate_causal
    from gsplat_core.io.recordings import open_recording
    from operators.applications.session import seeded

    settings = replace(settings, steps_per_frame=3)
    outcome = replay(settings)
    source = replay_module.prepare(settings, [])
    with seeded(settings.seed, "cpu"):
        expected = evaluate_causal(
            open_recording(settings.recording),
            replay_module.new_reconstructor(settings, source),
            PictureMaker(source.description.camera, "cpu", "alpha"),
        )
    found = outcome.find(NextFrameResult)
    assert found.frames == expected.frames == 3
    assert found.psnr_tissue_db == pytest.approx(expected.psnr_tissue_db, abs=0.05)
    assert found.previous_frame_db == pytest.approx(outcome.find(QualityResult).previous_frame_db)
    trained_db = [entry["psnr_tissue_db"] for entry in series(outcome)][1:]
    predicted_db = [entry["next_frame_db"] for entry in series(outcome)]
    assert predicted_db[0] is None
    assert sum(trained_db) > sum(predicted_db[1:]), "three steps on a frame make its picture better than its prediction"


def test_progress_includes_previous_frame_score(settings):
    events = []
    replay(settings, events.append)
    assert [event.previous_frame_db is None for event in events] == [True, True, False, False, False]
    assert all(event.trained for event in events)


def test_progress_has_no_score_for_withheld_frame(tiny, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for frame in open_recording(tiny):
        picture = frame.image if frame.seq != 3 else np.zeros_like(frame.image)
        cv2.imwrite(str(folder / f"{frame.seq:03d}.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    events = []
    replay(ReplaySettings(recording=folder, out=tmp_path / "out", steps_per_frame=1, out_of_body="off"), events.append)
    assert [event.psnr_tissue_db is None for event in events] == [True, False, False, False, True]


def test_replay_withholds_black_picture(tiny, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for frame in open_recording(tiny):
        picture = frame.image if frame.seq != 2 else np.zeros_like(frame.image)
        cv2.imwrite(str(folder / f"{frame.seq:03d}.png"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    outcome = replay(ReplaySettings(recording=folder, out=tmp_path / "out", steps_per_frame=1, out_of_body="off"))
    training, quality = outcome.find(TrainingCounts), outcome.find(QualityResult)
    assert training.withheld == {"black": 1} and training.frames == 3
    assert (quality.frames, quality.trained.count) == (4, 3)
    assert any("withheld and not scored (black: 1)" in note for note in outcome.notes)


@pytest.mark.parametrize(
    ("model", "poses", "refused"),
    [("fisheye", "estimated", True), ("fisheye", "auto", False), ("fisheye", "given", False), ("pinhole", "estimated", False)],
)  # fmt: skip
def test_prepare_refuses_estimated_poses_for_fisheye_camera(settings, monkeypatch, model, poses, refused):
    source = replay_module.open_source(settings.recording)
    about = source.description
    camera = Camera(about.camera.K, about.width_px, about.height_px, model=model)
    other = SimpleNamespace(description=replace(about, camera=camera))
    monkeypatch.setattr(replay_module, "open_source", lambda *_: other)
    wanted = replace(settings, poses=poses)
    if not refused:
        wanted.out.mkdir()
        assert replay_module.prepare(wanted, []) is other
        return
    with pytest.raises(InvalidSetting, match="this one is fisheye: undistort the pictures"):
        replay_module.prepare(wanted, [])


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("offline", [False, True])
def test_prepare_runs_all_checks_before_first_frame(tmp_path, monkeypatch, device, offline):
    made = []
    description = SimpleNamespace(
        name="clip", frame_count=9, width_px=80, height_px=60, fields={"depth"}, camera="camera", notes=("a note",)
    )
    source, config = SimpleNamespace(description=description), object()
    settings = SimpleNamespace(
        device=device, renderer="alpha", renderer_options="options", recording="recording", given_scale=0.5, max_frames=7,
        losses=("flow",), poses="auto", out=tmp_path, depth="stereo", eyes=None,
        reconstructor_config=lambda pixels=None, offline=False: made.append(("config", pixels, offline)) or config,
    )  # fmt: skip
    for name in ("check_device", "check_renderer", "check_compared", "check_picture", "check_poses"):
        monkeypatch.setattr(replay_module, name, lambda *given, name=name, **_: made.append((name, *given)))
    monkeypatch.setattr(replay_module, "open_source", lambda address, options: made.append(options) or source)
    monkeypatch.setattr(replay_module, "require_memory", lambda *given: made.append(("memory", given[0])))
    monkeypatch.setattr(replay_module, "replay_bytes", lambda description, config, offline: (config, offline))
    monkeypatch.setattr(replay_module, "lacking_depth", lambda settings, description, config: "no depth")
    monkeypatch.setattr(replay_module.StorageReserve, "require", lambda self: made.append("storage"))
    notes = []
    assert replay_module.prepare(settings, notes, offline=offline) is source
    no_eye = "depth is 'stereo', but clip has one eye, so that this has no effect"
    assert notes == ["a note", no_eye, "no depth"]
    options = replay_module.SourceOptions(0.5, 7)
    before = [
        ("check_device", device), ("check_renderer", "alpha", device), ("config", None, offline), options,
        ("check_compared", ("flow",), {"depth"}, "clip"), ("check_picture", "camera", 0.5), ("check_poses", "auto", "camera"),
    ]  # fmt: skip
    on_host = [("config", 4800, offline), ("memory", (config, offline))] if device == "cpu" else []
    assert made == [*before, *on_host, "storage"]
    description.frame_count = None
    with pytest.raises(InvalidSetting, match="clip has no end"):
        replay_module.prepare(settings, [])
