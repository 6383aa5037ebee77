"""Error of a run that showed nothing: number of frames, reasons for withholding, and remedies."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from gsplat_core.scene.cameras import Camera
from operators.applications.session import RunOutcome, RunSettings
from operators.checks import PICTURE_STAGES, MaskAndDepthStage, OutOfBodyFrames
from operators.display import LiveDisplayResult
from operators.errors import NothingShown
from operators.ingest import SourceResult
from operators.metrics import QualityResult
from operators.sinks.video import DisplayResult
from operators.sources.source import SourceDescription
from operators.training import TrainingCounts
from services.cli.terminal import BAD_INPUT, NOTHING_SHOWN, exit_code_of
from services.reports.build import REMEDIES, require_shown

CAMERA = Camera.from_focal(60.0, 64, 48)


def run_outcome(command, *parts, interrupted=False, wall_s=3.0, stop_reason="end of stream"):
    """Return the outcome of a run with the given parts."""
    return RunOutcome(
        command=command,
        settings=RunSettings("cpu", "embedded", "basis", "alpha", 0, 1.0, None, False),
        started_at=datetime.now(UTC),
        wall_s=wall_s,
        stop_reason=stop_reason,
        interrupted=interrupted,
        dropped=0,
        dropped_by_edge={},
        latency={},
        latency_quantiles_ms={},
        operators={},
        parts={type(part): part for part in parts},
        notes=(),
        outputs={},
        peak_memory_bytes=1,
    )


def source(frames, **more):
    description = SourceDescription(name="theatre 3", camera=CAMERA, width_px=64, height_px=48, fps=25.0)
    return SourceResult(description, frames, True, **more)


def withheld(**counts):
    return TrainingCounts(withheld={reason.replace("_", " "): count for reason, count in counts.items()})


def error_sentence(outcome):
    with pytest.raises(NothingShown) as error:
        require_shown(outcome)
    assert exit_code_of(error.value) == NOTHING_SHOWN == 3
    return str(error.value)


def test_nothing_shown_counts_withheld_frames_by_reason_with_remedies():
    gate = OutOfBodyFrames("withhold", 10, {"even light, no red": 30, "not yet certain again": 10})
    said = error_sentence(run_outcome("live", source(50), withheld(out_of_body=40, no_tissue=6, blur=4), gate))
    assert said == (
        "nothing was shown: 50 frames came, 50 withheld (out of body, mostly for even light, no red: 40, no tissue: 6, blur: 4);"
        " --out-of-body off lets these frames pass; --tool-mask none takes every pixel for tissue;"
        " a longer run shows such a stream after a second or two"
    )


def test_nothing_shown_names_remedies_of_occurred_reasons_only():
    said = error_sentence(run_outcome("live", source(1), withheld(black=1)))
    assert said == "nothing was shown: 1 frame came, 1 withheld (black: 1); check what the source sends"


def test_nothing_shown_states_source_state_if_no_frame_came():
    said = error_sentence(run_outcome("live", source(0, state_sentence="no data since 3 s"), withheld()))
    assert said.startswith(
        "nothing was shown: no frame came from theatre 3 in 3.0 s (no data since 3 s); check that it"
    )
    assert "(end of stream)" in error_sentence(run_outcome("live", source(0), withheld()))
    assert error_sentence(run_outcome("replay", source(0))).endswith("check that it holds frames")
    cut = error_sentence(run_outcome("live", source(0, counts={"cut_off": 1}), withheld()))
    assert cut.endswith("check the size and format that the address states")


def test_nothing_shown_if_run_ended_before_first_picture():
    said = error_sentence(run_outcome("live", source(3), withheld(), stop_reason="end of the time asked for"))
    assert "3 frames came, and the run ended before one was on the screen (end of the time asked for)" in said


def test_nothing_shown_in_replay_names_frames_withheld_in_recording():
    said = error_sentence(run_outcome("replay", source(8, withheld={"out of body": 8}), DisplayResult(0)))
    assert said.startswith(
        "nothing was shown: 8 frames came, 8 withheld when they were recorded (out of body: 8); record"
    )
    assert "check the connection, or the file" in error_sentence(run_outcome("replay", source(2, damaged=2)))


@pytest.mark.parametrize(
    "parts",
    [
        (LiveDisplayResult(1, None, None, None, {}, None),),
        (DisplayResult(1),),
        (QualityResult(None, None, (), 1, "", 1),),
    ],
)
def test_require_shown_accepts_run_that_showed_frame(parts):
    require_shown(run_outcome("live", source(5), withheld(blur=4), *parts))


def test_require_shown_accepts_interrupted_run_without_withheld_frames():
    require_shown(run_outcome("live", source(0), withheld(), interrupted=True))
    require_shown(run_outcome("live", source(2), withheld(), interrupted=True))
    assert "withheld (blur: 2)" in error_sentence(run_outcome("live", source(2), withheld(blur=2), interrupted=True))


def test_invalid_setting_exits_with_bad_input(capsys):
    from gsplat_core.errors import InvalidSetting

    assert exit_code_of(InvalidSetting("fps is nan")) == BAD_INPUT


def test_every_withholding_reason_has_remedy():
    """The reasons are the words returned by the functions of the stages' modules that return `str | None`."""
    import ast
    import inspect
    import re

    words = set()
    for make in (*PICTURE_STAGES.values(), MaskAndDepthStage):
        module = inspect.getsource(inspect.getmodule(make))
        # The gate reports frames that it withholds with one reason, whatever it saw.
        for core in set(re.findall(r"from gsplat_core\.endoscope\.(\w+) import", module)) - {"out_of_body"}:
            tree = ast.parse(inspect.getsource(__import__(f"gsplat_core.endoscope.{core}", fromlist=["x"])))
            words |= {
                each.value
                for function in ast.walk(tree)
                if isinstance(function, ast.FunctionDef) and function.returns
                if ast.unparse(function.returns) == "str | None"
                for statement in ast.walk(function)
                if isinstance(statement, ast.Return) and statement.value
                for each in ast.walk(statement.value)
                if isinstance(each, ast.Constant) and isinstance(each.value, str)
            }
    assert {"black", "torn", "no tissue"} <= words
    assert words - set(REMEDIES) <= {"depth repaired", "depth not usable", "depth at another scale"}


@pytest.mark.parametrize(
    ("command", "hint"), [("live", "give more --seconds"), ("replay", "check that it holds frames")]
)
def test_nothing_shown_if_run_ended_before_source_was_read(command, hint):
    said = error_sentence(run_outcome(command, stop_reason="a failure"))
    assert said.startswith("nothing was shown: no frame came from the source in 3.0 s (a failure)") and hint in said
    assert hint not in error_sentence(run_outcome("replay", source(2))) and "check the recording" in error_sentence(
        run_outcome("replay", source(2))
    )
    assert "give more --seconds, or a smaller --scale" in error_sentence(run_outcome("live", source(2), withheld()))
