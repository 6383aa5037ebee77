"""The command line without a run: help, version, invalid command lines, fast import."""

from __future__ import annotations

import subprocess
import sys

import pytest
import typer

from services.cli.app import app, run
from services.cli.terminal import BAD_INPUT


def test_help_names_every_command(capsys):
    assert run(["--help"]) == 0
    out = capsys.readouterr().out
    for command in ("replay", "reconstruct", "render", "synthesize", "validate", "doctor"):
        assert command in out
    assert "not a medical device" in " ".join(out.split())


def test_version_option_prints_version(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("intrasplat ")


@pytest.mark.parametrize(
    "arguments", [["replya"], ["replay"], ["replay", "x"], ["replay", "x", "--out", "y", "--seed", "one"]]
)
def test_wrong_command_line_exits_2_with_one_error_line(arguments, capsys):
    assert run(arguments) == BAD_INPUT
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert captured.err.rstrip().endswith("--help` lists what there is")


def test_missing_command_prints_help(capsys):
    assert run([]) == BAD_INPUT
    assert "Usage: intrasplat" in capsys.readouterr().out


def test_importing_cli_app_imports_no_heavy_libraries():
    code = (
        "import sys, services.cli.app; print(sorted({'torch', 'cv2', 'numpy', 'pydantic', 'fastapi'} & set(sys.modules)))\n"
        "assert services.cli.app.run(['replay', '--help']) == 0; print(sorted({'torch', 'cv2', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.splitlines()[0], done.stdout.splitlines()[-1]) == ("[]", "[]")


def test_importing_cli_runs_imports_no_database_libraries():
    code = "import sys, services.cli.runs; print(sorted({'sqlalchemy', 'alembic', 'fastapi'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def commands(group, path=()):
    """Yield the words of every command and its parameters."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command.params


CONTEXT = typer.Context(typer.main.get_command(app))
EVERY_COMMAND = dict(commands(CONTEXT.command))


@pytest.mark.parametrize("words", EVERY_COMMAND, ids=" ".join)
def test_commands_refuse_empty_arguments_and_options(words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # an empty path must not stand for the current folder
    options = [each.opts[-1] for each in EVERY_COMMAND[words] if each.opts[-1].startswith("--") and not each.is_flag]
    arguments = sum(each.param_type_name == "argument" for each in EVERY_COMMAND[words])
    lines = [[f"{option}="] for option in options] + [[option, ""] for option in options]
    lines += [["given"] * place + [""] for place in range(arguments)]
    for line in lines:
        assert run([*words, *line]) == BAD_INPUT, line
        shown = capsys.readouterr()
        assert shown.out == "" and "is empty; a variable of the shell may be unset" in shown.err, line
    assert list(tmp_path.iterdir()) == []


def is_numeric(parameter) -> bool:
    """Return true if the parameter accepts a number. One of the tried values is in the range of each option."""
    for text in ("9", "200", "0.5"):
        try:
            found = parameter.process_value(CONTEXT, text)
        except Exception:  # noqa: BLE001 - an option of another kind, or out of the range of this one
            continue
        return type(found) in (int, float)
    return False


def test_is_numeric_recognises_numeric_options():
    numeric = {
        (words[0], each.opts[-1]) for words, every in EVERY_COMMAND.items() for each in every if is_numeric(each)
    }
    wanted = {
        ("replay", "--seed"),
        ("live", "--fps"),
        ("synthesize", "--smoke"),
        ("batch", "--workers"),
        ("igtl", "--port"),
    }
    assert wanted <= numeric and not {("replay", "--device"), ("replay", "--heldout")} & numeric


@pytest.mark.slow
@pytest.mark.parametrize("words", EVERY_COMMAND, ids=" ".join)
def test_numeric_options_refuse_underscores_and_non_ascii_digits(words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    takes = [each for each in EVERY_COMMAND[words] if each.opts[-1].startswith("--") and not each.is_flag]
    for option in (each.opts[-1] for each in takes if is_numeric(each)):
        for number in ("1_0", "９") if option == "--seed" else ("1_0",):
            assert run([*words, option, number]) == BAD_INPUT, (option, number)
            shown = capsys.readouterr()
            assert shown.out == "" and shown.err.count("\n") == 1
            assert shown.err.startswith("error: Invalid value for ") and option in shown.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", ["1_0", "１０", " 10"])
def test_budget_ms_refuses_unusual_number_spellings(number, capsys, tmp_path):
    assert run(["live", str(tmp_path), "--budget-ms", number]) == BAD_INPUT
    assert "budget_ms is" in capsys.readouterr().err


def test_steps_option_accepts_plain_integer(capsys, tmp_path):
    assert run(["reconstruct", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"), "--steps", "5"]) == BAD_INPUT
    assert "there is no such file" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["1_0", "１０", " 10"])
def test_parsers_of_composite_values_refuse_unusual_number_spellings(number):
    from datetime import datetime

    from gsplat_core.errors import InvalidSetting
    from operators.sources.address import Address
    from services.cli.ctl import moment
    from services.cli.models import pixel_of
    from services.cli.runs import _place, recording_kept

    assert isinstance(moment("10m"), datetime)
    assert pixel_of("10,10") == (10, 10) and _place("0:2,10:12").again == (10, 12)
    with pytest.raises(InvalidSetting, match="place is"):
        _place(f"0:2,{number}:12")
    with pytest.raises(InvalidSetting):
        Address.parse("x", f"//place?fps={number}").number("fps", None, 1, 100)
    with pytest.raises(InvalidSetting):
        Address.parse("x", f"//place?size={number}x10").size()
    if number != " 10":  # blanks around these are allowed
        for read, text in ((pixel_of, f"{number},10"), (recording_kept, [f"{number}GiB"]), (moment, f"{number}m")):
            with pytest.raises(InvalidSetting):
                read(text)
