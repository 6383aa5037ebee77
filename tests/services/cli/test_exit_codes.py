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
def test_a_missing_file_is_the_users_where_they_named_it(named, arguments, code, capsys):
    assert exit_code_of(FileNotFoundError(errno.ENOENT, "No such file or directory", named), arguments) == code


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENOMEM, errno.EIO])
def test_what_a_machine_lacks_is_never_a_bug(number, capsys):
    assert exit_code_of(OSError(number, os.strerror(number))) == BAD_INPUT
    assert os.strerror(number) in capsys.readouterr().err


def out_of_memory(call):
    with pytest.raises((MemoryError, RuntimeError)) as caught:
        call()
    return caught.value


@pytest.mark.parametrize(
    "call", [lambda: bytearray(1 << 62), lambda: torch.empty(1 << 50, dtype=torch.uint8)], ids=["python", "torch"]
)
def test_memory_that_is_not_there_is_a_sentence(call, capsys):
    error = caused(RunFailed("early", None), OperatorFailed("reconstruct", "compute", out_of_memory(call), 3))
    assert exit_code_of(error) == BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: there is not enough memory") and "in operator reconstruct on frame 3" in err
    assert "Traceback" not in err


def test_a_refused_thread_is_a_sentence(capsys):
    assert exit_code_of(caused(RunFailed("early", None), RuntimeError("can't start new thread"))) == BAD_INPUT
    err = capsys.readouterr().err
    assert err.startswith("error: the system refuses another thread") and "ulimit -u" in err


def test_every_error_on_purpose_is_either_the_users_or_a_bug():
    """InvalidInput, the graph's errors and their like are a program's mistakes: none of them is a UserError."""

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
def test_a_name_does_not_steer_the_terminal(name, capsys):
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
def test_a_bug_keeps_its_traceback(error, capsys):
    try:
        raise error
    except Exception as caught:  # noqa: BLE001 - any error may be a bug
        assert exit_code_of(caught) == BUG
    err = capsys.readouterr().err
    assert "Traceback" in err and "this is a bug in intrasplat" in err


def test_an_interrupt_is_130(capsys):
    assert exit_code_of(KeyboardInterrupt()) == INTERRUPTED
