"""The command line without a run: help, versions, wrong options, exit codes, a quick import."""

from __future__ import annotations

import subprocess
import sys

import pytest

from gsplat_core.errors import RecordingInvalid
from operators.errors import GraphInvalid, OperatorFailed, RunFailed, StorageFull
from services.cli.app import run
from services.cli.exit_codes import BAD_INPUT, BUG, INTERRUPTED, exit_code_of


def test_help_names_every_command(capsys):
    assert run(["--help"]) == 0
    out = capsys.readouterr().out
    for command in ("replay", "reconstruct", "render", "synthesize", "validate", "doctor"):
        assert command in out
    assert "not a medical device" in " ".join(out.split())


def test_version(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("intrasplat ")


@pytest.mark.parametrize(
    "arguments", [["replya"], ["replay"], ["replay", "x"], ["replay", "x", "--out", "y", "--seed", "one"]]
)
def test_a_wrong_command_line_is_2(arguments, capsys):
    assert run(arguments) == BAD_INPUT
    assert "Traceback" not in capsys.readouterr().err


def test_importing_the_command_is_quick_because_it_imports_nothing_heavy():
    code = "import sys, services.cli.app; print(sorted({'torch', 'cv2', 'numpy', 'pydantic', 'fastapi'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def caused(error, cause):
    error.__cause__ = cause
    return error


def test_the_cause_under_an_operator_and_a_run_is_what_the_user_reads(capsys):
    bad_file = RecordingInvalid("mask 7 is 10x10. Save it at the size of the frames.")
    error = caused(RunFailed("the replay ended early", None), OperatorFailed("source", "compute", bad_file, 7))
    assert exit_code_of(error) == BAD_INPUT
    assert (
        capsys.readouterr().err
        == "error: mask 7 is 10x10. Save it at the size of the frames.\n  in operator source on frame 7\n"
    )


def test_a_full_disk_and_a_missing_right_are_the_users(capsys):
    assert exit_code_of(StorageFull("the disk of /x is full")) == BAD_INPUT
    assert exit_code_of(PermissionError(13, "Permission denied", "/x/y")) == BAD_INPUT
    assert "/x/y: Permission denied" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error",
    [
        ValueError("x"),
        GraphInvalid("port"),
        caused(RunFailed("early", None), OperatorFailed("deform", "compute", TypeError("x"), 1)),
    ],
)
def test_a_bug_keeps_its_traceback(error, capsys):
    try:
        raise error
    except Exception as caught:  # noqa: BLE001 - any error may be a bug
        assert exit_code_of(caught) == BUG
    err = capsys.readouterr().err
    assert "Traceback" in err and "this is a bug in intrasplat" in err


def test_an_interrupt_is_130(capsys):
    assert exit_code_of(KeyboardInterrupt()) == INTERRUPTED
