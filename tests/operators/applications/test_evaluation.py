"""Settings of an evaluation at their borders."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.training.config import ReconstructorConfig
from operators.applications import evaluate
from operators.applications.evaluate import EvaluationSettings
from operators.applications.evaluated import EvaluatedRun


@pytest.mark.parametrize(
    ("name", "possible", "impossible"),
    [
        ("protocols", [(), ("heldout", "causal"), ("geometry",)], [("all",), ("heldout", "")]),
        ("motion_prior", [None], ["crystal ball"]),
        ("scale", [None, 64.0], [0.0, 64.1]),
        ("steps_per_frame", [None, 1], [0]),
        ("max_frames", [None, 1], [0]),
    ],
)
def test_evaluation_settings_refuse_values_out_of_range(name, possible, impossible):
    for value in possible:
        assert getattr(EvaluationSettings("clip.mp4", **{name: value}), name) == value
    for value in impossible:
        with pytest.raises(InvalidSetting):
            EvaluationSettings("clip.mp4", **{name: value})


def run_of(folder: Path, **changed: Any) -> EvaluatedRun:
    return replace(EvaluatedRun(folder, "live", "hexplane", 7, 12, 0.5, True, "both"), **changed)


def work(tmp_path: Path, run: EvaluatedRun | None = None, **settings: Any) -> evaluate._Work:
    made = object.__new__(evaluate._Work)
    made.run, made.notes, made.folder, made.scale = run, [], tmp_path, 0.5
    made.settings = EvaluationSettings(recording=Path("recording"), **settings)
    return made


@pytest.mark.parametrize(
    ("run_steps", "asked", "steps", "note"),
    [
        (12, None, 12, None), (12, 30, 30, None), (None, 30, 30, None), (None, None, None, "did not train frame by frame"),
        ("no run", 30, 30, "the settings of the model's training are not known"), ("no run", None, None, "training are not known"),
    ],
)  # fmt: skip
def test_causal_protocol_uses_training_settings_of_run(
    tmp_path: Path, run_steps: Any, asked: int | None, steps: int | None, note: str | None
) -> None:
    run = None if run_steps == "no run" else run_of(tmp_path, steps_per_frame=run_steps)
    made = work(tmp_path, run, steps_per_frame=asked)
    found = made._learning_settings()
    assert found.steps_per_frame == steps and found.scale == 0.5 and found.out == tmp_path
    assert (found.field, found.seed, found.eyes) == (("auto", 0, None) if run is None else ("hexplane", 7, "both"))
    assert len(made.notes) == (note is not None) and (note is None or note in made.notes[0])


@pytest.mark.parametrize("has_camera", [True, False])
def test_second_eye_without_camera_pose_adds_note(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_camera: bool
) -> None:
    made = work(tmp_path)
    made.camera, made.window_s = "camera", (0.0, 1.0)
    monkeypatch.setattr(made, "_of_final_model", lambda right: lambda frame, eye: SimpleNamespace(unrounded=right))
    monkeypatch.setattr(made, "_frames", lambda name: name)
    monkeypatch.setattr(made, "_log", lambda name: nullcontext())

    def second_eye(frames: Any, camera: Any, shown: Any, *, window_s: Any, record: Any) -> str | None:
        assert (frames, camera, window_s, shown(None, None)) == ("second_eye", "camera", (0.0, 1.0), True)
        return "score" if has_camera else None

    monkeypatch.setattr(evaluate, "evaluate_second_eye", second_eye)
    assert made._second_eye() == ("score" if has_camera else None)
    assert len(made.notes) == (not has_camera)


@pytest.mark.parametrize("stops_after", [0, 1, 2, 99])
def test_interrupted_evaluation_keeps_measured_protocols(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops_after: int
) -> None:
    made, measured = work(tmp_path), []
    made.source, made.logs = SimpleNamespace(description="description"), {}
    made.stop_requested = lambda: len(measured) >= stops_after
    monkeypatch.setattr(made, "_is_wanted", lambda name: name in ("heldout", "causal", "geometry"))
    monkeypatch.setattr(made, "_frames", lambda name: name)
    monkeypatch.setattr(made, "_log", lambda name: nullcontext())
    monkeypatch.setattr(made, "_returns", lambda retention: {})
    monkeypatch.setattr(evaluate, "measure_baselines", lambda frames, **_: frames)
    for name in evaluate.PROTOCOLS:
        monkeypatch.setattr(made, f"_{name}", lambda name=name: measured.append(name) or name)
    found = made.done()
    assert measured == [name for name in evaluate.PROTOCOLS if name in ("heldout", "causal", "geometry")][:stops_after]
    assert found.interrupted == (stops_after < 3) == ("interrupted" in " ".join(found.notes))
    assert found.baselines == "baselines" and found.wall_s >= 0


@pytest.mark.parametrize(
    ("name", "given", "reason"),
    [
        ("heldout", {}, None), ("heldout", {"heldout": False}, "trained on the held-out frames"), ("heldout", {"run": None}, None),
        ("second_eye", {}, None), ("second_eye", {"is_stereo": False}, "has no right eye"),
        ("live", {}, None), ("live", {"run": None}, "needs the folder of a live run"), ("live", {"is_live": False}, "was not a live run"),
        ("geometry", {}, None), ("geometry", {"model": "fisheye"}, "this one is fisheye"), ("retention", {"run": None}, None),
    ],
)  # fmt: skip
def test_unmeasurable_protocol_is_refused_if_requested_and_noted_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, given: dict[str, Any], reason: str | None
) -> None:
    """Requested protocols are rejected, default protocols are noted, and stereo protocols of a monocular recording are skipped silently."""
    run = given["run"] if "run" in given else run_of(tmp_path, heldout=given.get("heldout", True))
    monkeypatch.setattr(evaluate, "is_live_log", lambda path: given.get("is_live", True))
    for asked in (True, False):
        made = work(tmp_path, run, **({"protocols": (name,)} if asked else {}))
        made.source = SimpleNamespace(description=SimpleNamespace(is_stereo=given.get("is_stereo", True)))
        made.camera = SimpleNamespace(model=given.get("model", "pinhole"))
        if reason is not None and asked:
            with pytest.raises(InvalidSetting, match=reason):
                made._is_wanted(name)
            continue
        assert made._is_wanted(name) == (reason is None)
        silent = reason is None or name == "second_eye"
        notes = [note for note in made.notes if "was not measured" in note]
        assert len(notes) == (not silent) and all(reason in note for note in notes)
        assert any("it is not known whether" in note for note in made.notes) == (name == "heldout" and run is None)


def test_causal_and_retention_protocols_run_only_if_requested(tmp_path: Path) -> None:
    assert not work(tmp_path)._is_wanted("causal")
    assert not work(tmp_path, protocols=("retention",))._is_wanted("causal")
    assert work(tmp_path, protocols=("causal",))._is_wanted("causal")
    assert not work(tmp_path, protocols=("causal",))._is_wanted("retention")


@pytest.mark.parametrize(("device", "is_checked"), [("cpu", True), ("cuda", False)])
@pytest.mark.parametrize("prior", [None, "learned"])
def test_causal_protocol_uses_gaussian_count_of_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, is_checked: bool, prior: str | None
) -> None:
    made, checked, sizes = work(tmp_path, run_of(tmp_path), device=device, motion_prior=prior), [], []
    made.source, made.camera = SimpleNamespace(description=SimpleNamespace(width_px=80, height_px=60)), "camera"
    config = ReconstructorConfig(steps_per_frame=12)
    settings = SimpleNamespace(
        device=device, seed=7, reconstructor_config=lambda pixels: sizes.append(pixels) or config
    )
    monkeypatch.setattr(made, "_learning_settings", lambda: settings)
    monkeypatch.setattr(made, "_frames", lambda name: name)
    monkeypatch.setattr(made, "_log", lambda name: nullcontext())
    monkeypatch.setattr(evaluate, "replay_bytes", lambda description, config: 5)
    monkeypatch.setattr(evaluate, "require_memory", lambda *given: checked.append(given[0]))
    monkeypatch.setattr(evaluate, "Reconstructor", lambda config, camera, **_: config)
    monkeypatch.setattr(evaluate, "PictureMaker", lambda *given: given)
    monkeypatch.setattr(evaluate, "seeded", lambda seed, device: nullcontext())
    monkeypatch.setattr(evaluate, "evaluate_causal", lambda frames, learning, pictures, record: learning)
    found = made._causal()
    assert sizes == [80 * 60] and checked == [5] * is_checked
    learned = found.score
    assert (learned.start_from_motion, learned.depth_from_motion) == ((True, True) if prior else (config.start_from_motion, config.depth_from_motion))  # fmt: skip
    assert found.motion_prior == (prior or config.motion_prior) and (found.steps_per_frame, found.seed) == (12, 7)


def test_retention_notes_stays_without_a_scored_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    visits = (evaluate.Visits((0.0, 1.0), (2.0, 3.0)), evaluate.Visits((0.0, 1.0), (5.0, 6.5)))
    made = work(tmp_path, places=visits)
    made.model = SimpleNamespace(time_window_s=(0.0, 4.0))  # type: ignore[assignment]
    made.playback = SimpleNamespace(round_s=0.0, last_s=4.0)  # type: ignore[assignment]
    monkeypatch.setattr(made, "_log", lambda name: nullcontext())
    monkeypatch.setattr(made, "_frames", lambda *which: ())
    monkeypatch.setattr(made, "_of_final_model", lambda: None)
    scored = lambda stay: SimpleNamespace(frames=5 if stay[1] <= 4 else 0)
    places = [SimpleNamespace(visits=each, first=scored(each.first), again=scored(each.again)) for each in visits]
    monkeypatch.setattr(evaluate, "evaluate_retention", lambda *given, **options: SimpleNamespace(places=places))
    assert made._retention().places == places
    assert made.notes == ["no frame was scored from 5 to 6.5 s; the model covers 0 to 4 s"]
