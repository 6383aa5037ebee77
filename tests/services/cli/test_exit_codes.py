"""User errors print one sentence and exit with 2; all other errors print a traceback and exit with 1."""

from __future__ import annotations

import errno
import os

import pytest
import torch

from gsplat_core.errors import CoreError, InvalidInput, InvalidSetting, RecordingInvalid, UserError
from operators.errors import GraphInvalid, OperatorFailed, OperatorsError, RunFailed, StorageFull
from services.cli.terminal import BAD_INPUT, BUG, INTERRUPTED, exit_code_of


def caused(error, cause):
    error.__cause__ = cause
    return error


def test_exit_code_of_prints_root_cause_with_operator_and_frame(capsys):
    bad_file = RecordingInvalid("mask 7 is 10x10. Save it at the size of the frames.")
    error = caused(RunFailed("the replay ended early", None), OperatorFailed("source", "compute", bad_file, 7))
    assert exit_code_of(error) == BAD_INPUT
    assert (
        capsys.readouterr().err
        == "error: mask 7 is 10x10. Save it at the size of the frames.\n  in operator source on frame 7\n"
    )


def test_full_disk_and_missing_permission_are_bad_input(capsys):
    assert exit_code_of(StorageFull("the disk of /x is full")) == BAD_INPUT
    assert exit_code_of(PermissionError(13, "Permission denied", "/x/y"), ["replay", "/x"]) == BAD_INPUT
    assert "/x/y: Permission denied" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("named", "arguments", "code"),
    [
        ("/data/take/images/1.png", ["validate", "/data/take"], BAD_INPUT),
        ("/data", ["replay", "x", "--out=/data/out"], BAD_INPUT),
        (b"/data/take", ["validate", "/data/take"], BAD_INPUT),
        (os.path.abspath("relative/a"), ["validate", "relative"], BAD_INPUT),
        ("/usr/lib/python3/style.css", ["validate", "/data/take"], BUG),
        ("/data/taken", ["validate", "/data/take"], BUG),
        (None, ["validate", "/data/take"], BUG),
    ],
)
def test_missing_file_is_bad_input_only_if_named_in_arguments(named, arguments, code, capsys):
    assert exit_code_of(FileNotFoundError(errno.ENOENT, "No such file or directory", named), arguments) == code


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENOMEM, errno.EIO])
def test_resource_errors_of_system_are_bad_input(number, capsys):
    assert exit_code_of(OSError(number, os.strerror(number))) == BAD_INPUT
    assert os.strerror(number) in capsys.readouterr().err


def out_of_memory(call):
    with pytest.raises((MemoryError, RuntimeError)) as caught:
        call()
    return caught.value


@pytest.mark.parametrize(
    "call", [lambda: bytearray(1 << 62), lambda: torch.empty(1 << 50, dtype=torch.uint8)], ids=["python", "torch"]
)
def test_out_of_memory_prints_error_without_traceback(call, capsys):
    error = caused(RunFailed("early", None), OperatorFailed("reconstruct", "compute", out_of_memory(call), 3))
    assert exit_code_of(error) == BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: there is not enough memory") and "in operator reconstruct on frame 3" in err
    assert "Traceback" not in err


def test_thread_limit_prints_error_with_advice(capsys):
    assert exit_code_of(caused(RunFailed("early", None), RuntimeError("can't start new thread"))) == BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: the system refuses another thread") and "ulimit -u" in err


def test_user_errors_are_separate_from_programming_errors():
    """Errors such as InvalidInput and those of the graph are programming errors, not UserErrors."""

    def family(kind):
        return {kind}.union(*(family(child) for child in kind.__subclasses__()))

    users = {
        error.__name__ for base in (CoreError, OperatorsError) for error in family(base) if issubclass(error, UserError)
    }
    assert {
        "InvalidSetting",
        "RecordingInvalid",
        "BundleCorrupt",
        "StorageFull",
        "DeviceMissing",
        "EngineMissing",
    } <= users
    assert users.isdisjoint(
        {"InvalidInput", "GraphInvalid", "PortError", "OperatorFailed", "GraphDeadlock", "CoreError"}
    )


@pytest.mark.parametrize("name", ["line\nbreak", "\x1b[31mred", "\r", "caf\u00e9 \udcff"])
def test_error_output_escapes_control_characters(name, capsys):
    assert exit_code_of(InvalidSetting(f"{name} is bad")) == BAD_INPUT
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and all(character.isprintable() for character in err.rstrip("\n"))


@pytest.mark.parametrize(
    "error",
    [
        ValueError("x"),
        InvalidInput("means must be [N, 3]"),
        caused(RunFailed("early", None), OperatorFailed("rasterize", "compute", InvalidInput("means"), 1)),
        caused(ValueError("x"), RecordingInvalid("the cause of a bug may be the user's, the bug is not")),
        GraphInvalid("port"),
        caused(RunFailed("early", None), OperatorFailed("deform", "compute", TypeError("x"), 1)),
    ],
)
def test_programming_error_prints_traceback(error, capsys):
    try:
        raise error
    except Exception as caught:  # noqa: BLE001 - any error may be a bug
        assert exit_code_of(caught) == BUG
    err = capsys.readouterr().err
    assert "Traceback" in err and "this is a bug in intrasplat" in err


def test_keyboard_interrupt_exits_130(capsys):
    assert exit_code_of(KeyboardInterrupt()) == INTERRUPTED
