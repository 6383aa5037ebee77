"""Conversion of an API stream to process specifications, and of process states to the stream state."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from services.settings import StreamSettings
from services.supervisor import worker as workers
from services.supervisor.engine import live_settings
from services.supervisor.process import ProcessState
from services.supervisor.stream import overall
from services.supervisor.worker import specs_of


def engine_of(device="cpu", **options):
    return specs_of("theatre-1", wanted(device, **options))["engine"].engine


def wanted(device="cpu", **options):
    settings = StreamSettings(source="synthetic:?width=64", device=device)
    return settings.model_copy(update={"options": options})  # not checked yet


def test_specs_of_passes_options_to_capture_or_engine():
    specs = specs_of("theatre-1", wanted(scale=0.5, tool_mask="none", seed=None))
    capture, engine = specs["capture"].capture, specs["engine"].engine
    assert {spec.stream for spec in specs.values()} == {"theatre-1"}
    assert (capture.address, capture.scale) == ("synthetic:?width=64", 0.5)
    assert (engine.device, engine.gpu, engine.tool_mask, engine.seed) == ("cpu", None, "none", 0)


@pytest.mark.parametrize(
    ("device", "found", "expected"),
    [("cpu", 2, ("cpu", None)), ("cuda", 2, ("cuda", None)), ("cuda:1", 2, ("cuda", 1)), ("auto", 0, ("cpu", None)), ("auto", 1, ("cuda", None))],
)  # fmt: skip
def test_specs_of_resolves_device_and_gpu(monkeypatch, device, found, expected):
    monkeypatch.setattr(workers, "gpus", lambda: found)
    engine = engine_of(device)
    assert (engine.device, engine.gpu) == expected


@pytest.mark.parametrize("device", ["cuda:1000", "cuda:", "gpu", "cuda:-1"])
def test_stream_settings_refuse_unknown_devices(device):
    with pytest.raises(ValueError, match="device"):
        engine_of(device)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"scael": 1}, "no option 'scael'; the nearest is 'scale'"),
        ({"gpu": 1}, "no option 'gpu'"),
        ({"gpu": None}, "no option 'gpu'"),
        ({"scale": 9}, "scale is 9; it must be above 0 and at most 4"),
        ({"budget_ms": "soon"}, "budget_ms is 'soon'; it must be a number"),
    ],
)
def test_specs_of_raises_for_unknown_or_invalid_options(options, said):
    with pytest.raises(InvalidSetting, match=said):
        engine_of(**options)


@pytest.mark.parametrize(
    ("option", "value"),
    [(name, value) for name in ("scale", "fps", "engine_scale", "seed", "budget_ms") for value in (True, False, "1", "nan", float("nan"), float("inf"), 1e400, -1, 10**30)]
    + [("loop", value) for value in (0, 1, "yes", "true", 1.0)]
    + [(name, value) for name in ("eyes", "poses", "out_of_body", "field", "renderer") for value in (True, 1, "", "x")],
)  # fmt: skip
def test_specs_of_does_not_convert_option_types(option, value):
    with pytest.raises(InvalidSetting, match=option):
        engine_of(**{option: value})


@pytest.mark.parametrize("option", ["tool_mask", "depth"])
@pytest.mark.parametrize(
    "value",
    ["onnx", "onnx:", "onnx:a.onnx", "onnx:../a.onnx", "onnx:/etc/passwd", "onnx:/none.onnx", "recorded:1", "none:"],
)
def test_specs_of_rejects_option_with_missing_onnx_file(option, value):
    with pytest.raises(InvalidSetting, match=option):
        engine_of(**{option: value})


def test_specs_of_accepts_existing_onnx_file(tmp_path):
    network = tmp_path / "tools.onnx"
    network.write_bytes(b"")
    assert engine_of(tool_mask=f"onnx:{network}").tool_mask == f"onnx:{network}"


def test_overall_reports_source_lost_if_source_never_opened():
    """A missing camera stays in state `opening`, which counts as lost after a while, as in the audit log."""
    absent = ProcessState("opening", "there is no camera", 1, 0, {}, 0.1, lost=True)
    assert overall(absent, process("running")) == ("source lost", "there is no camera")


def process(state, reason="", **figures):
    return ProcessState(state, reason, 1, 0, figures, 0.1)


@pytest.mark.parametrize(
    ("capture", "engine", "expected"),
    [
        (process("live"), process("running", picture={"state": "live"}), ("live", None)),
        (process("live"), process("running", picture={"state": "stale"}), ("stale", None)),
        (process("live"), process("running"), ("starting", "the first picture is being made")),
        (process("starting", "opens it"), process("running"), ("starting", "opens it")),
        (process("stalled", "no frame for 2 s"), process("running"), ("source lost", "no frame for 2 s")),
        (process("failed", "no such file"), process("starting"), ("failed", "no such file")),
        (process("live"), process("down", "killed by SIGKILL"), ("starting", "the camera's picture is live; the engine is down: killed by SIGKILL")),
    ],
)  # fmt: skip
def test_overall_state_follows_capture_and_engine(capture, engine, expected):
    assert overall(capture, engine) == expected


def test_overall_explains_missing_picture_by_withheld_frames():
    capture = ProcessState("live", "", 1, 0, {}, 0.1)

    def reason(picture=None, **figures):
        engine = ProcessState(
            "running", "reconstructs", 2, 0, {**figures, **({"picture": picture} if picture else {})}, 0.1
        )
        return overall(capture, engine)

    withheld = {"blur": 2, "out of body": 40}
    assert reason(frames=45, withheld=withheld) == (
        "starting",
        "nothing is shown: of 45 frames 42 were withheld (out of body: 40, blur: 2);"
        " the stream's option out_of_body: off lets those out of body pass",
    )
    assert reason(frames=2, withheld={"black": 2})[1] == (
        "nothing is shown: of 2 frames 2 were withheld (black: 2); check what the source sends"
    )
    for figures in (
        {},
        {"frames": 3},
        {"frames": 3, "withheld": {}},
        {"frames": 0, "withheld": {"blur": 1}},
        {"frames": 3, "withheld": None},
    ):
        assert reason(**figures) == ("starting", "the first picture is being made")
    assert reason(picture={"state": "live"}, frames=45, withheld=withheld) == ("live", None)


def test_overall_explains_frozen_picture_by_withheld_frames():
    capture = ProcessState("live", "", 1, 0, {}, 0.1)

    def reason(state, **withheld):
        figures = {"frames": 900, "withheld": {"blur": 99}, "withheld_now": withheld, "picture": {"state": state}}
        return overall(capture, ProcessState("running", "reconstructs", 2, 0, figures, 0.1))

    assert reason("frozen", **{"no tissue": 30, "blur": 2}) == (
        "frozen",
        "nothing new is shown: the last 32 frames were withheld (no tissue: 30, blur: 2);"
        " the stream's option tool_mask: none takes every pixel for tissue",
    )
    assert reason("stale", blur=3) == ("stale", None) and reason("live", blur=30) == ("live", None)


def test_depth_eyes_and_poses_options_reach_live_settings(tmp_path):
    asked = engine_of(depth="stereo", eyes="both", poses="estimated")
    settings = live_settings(asked, tmp_path, "a source")
    assert (settings.depth, settings.eyes, settings.poses) == ("stereo", "both", "estimated")
    usual = live_settings(engine_of(), tmp_path, "a source")
    assert (usual.depth, usual.eyes, usual.poses) == ("auto", None, "given")
    with pytest.raises(InvalidSetting, match="eyes"):
        engine_of(eyes="right")
