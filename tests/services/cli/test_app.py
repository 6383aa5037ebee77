"""The command line without a run: help, versions, a wrong command line, a quick import."""

from __future__ import annotations

import subprocess
import sys

import pytest
import typer

from services.cli.app import app, run
from services.cli.exit_codes import BAD_INPUT


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
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert captured.err.rstrip().endswith("--help` lists what there is")


def test_without_a_command_there_is_help(capsys):
    assert run([]) == BAD_INPUT
    assert "Usage: intrasplat" in capsys.readouterr().out


def test_importing_the_command_is_quick_because_it_imports_nothing_heavy():
    code = (
        "import sys, services.cli.app; print(sorted({'torch', 'cv2', 'numpy', 'pydantic', 'fastapi'} & set(sys.modules)))\n"
        "assert services.cli.app.run(['replay', '--help']) == 0; print(sorted({'torch', 'cv2', 'numpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout.splitlines()[0], done.stdout.splitlines()[-1]) == ("[]", "[]")


def commands(group, path=()):
    """Yield the words of every command and its parameters."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command.params


EVERY_COMMAND = dict(commands(typer.main.get_command(app)))


@pytest.mark.parametrize("words", EVERY_COMMAND, ids=" ".join)
def test_an_empty_argument_or_option_of_any_command_is_refused(words, capsys, monkeypatch, tmp_path):
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
