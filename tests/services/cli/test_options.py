"""Impossible values of command options: exit code 2, one error line, no traceback, no files."""

from __future__ import annotations

import os

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from gsplat_core.errors import InvalidInput
from gsplat_core.io.bundle import save_bundle
from services.cli.app import run

COMMANDS = {
    "replay": ("--device", "--engine", "--field", "--seed", "--steps-per-frame", "--max-frames", "--scale", "--out"),
    "reconstruct": ("--device", "--field", "--seed", "--steps", "--max-frames", "--scale", "--out"),
    "render": ("--fps", "--scale", "--device", "--out"),
    "synthesize": ("--frames", "--width", "--height", "--fps", "--seed", "--out"),
}
VALID = {"--seed": range(2**63), "--frames": range(1, 100_001), "--width": range(32, 4097), "--height": range(32, 4097)}
VALID |= {
    "--steps": range(1, 10**8 + 1),
    "--steps-per-frame": range(1, 10**8 + 1),
    "--max-frames": range(1, 10**9 + 1),
}
BOUNDS = {"--scale": 64.0, "--fps": 1000.0}
NAMES = {"--device": ("cpu",), "--engine": ("embedded", "holoscan"), "--field": ("auto", "basis", "hexplane")}


def may_work(option: str, value: str) -> bool:
    """Return true if the value could be valid. The test skips such values."""
    if option in NAMES:
        return value in NAMES[option]
    if option == "--steps" and value == "auto":
        return True
    try:
        if option in VALID:
            return int(float(value)) in VALID[option] if value.strip() == value else True
        return 0 < float(value) <= BOUNDS[option]
    except (ValueError, OverflowError):
        return False


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """The smallest possible model and recording."""
    import torch

    from gsplat_core.io.recordings import synthesize
    from gsplat_core.models import Model
    from gsplat_core.scene.cameras import Camera
    from gsplat_core.scene.gaussians import Gaussians

    folder = tmp_path_factory.mktemp("inputs")
    gaussians = Gaussians(
        torch.tensor([[0.0, 0, 5]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.zeros(1, 3),
        torch.zeros(1),
        torch.zeros(1, 1, 3),
    )
    save_bundle(Model(1, gaussians, None, Camera.from_focal(32, 32, 32), (0.0, 0.1)), folder / "model")
    take = synthesize(folder / "take", frames=1, width_px=32, height_px=32, stereo=False)
    return {"render": folder / "model", "replay": take, "reconstruct": take}


def refused(arguments, capsys):
    code = run([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert code == 2, (arguments, code, captured.err[-2000:])
    assert "Traceback" not in captured.err and captured.out == ""
    lines = captured.err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), captured.err
    return lines[0]


values = st.one_of(
    st.integers().map(str),
    st.floats().map(repr),
    st.sampled_from(["", " ", "0", "-1", "-0.0", "nan", "inf", "-inf", "1e309", "1e-400", "9" * 400, "0x10", "1_0", "--", "-"]),
    st.text(st.characters(codec=None, categories=None), max_size=12),
)  # fmt: skip


@pytest.mark.parametrize(
    ("command", "option"), [(c, o) for c, options in COMMANDS.items() for o in options if o != "--out"]
)
def test_invalid_option_values_exit_2_with_one_error_line(command, option, inputs, tmp_path_factory, capsys):
    folder = tmp_path_factory.mktemp("out")

    @settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(value=values.filter(lambda value: not may_work(option, value)))
    @example(value="")
    @example(value="-1")
    @example(value="nan")
    @example(value="1" + "0" * 30)
    @example(value="\udcff\x00\n\x1b[31m")
    def check(value):
        target = [inputs[command]] if command in inputs else []
        refused([command, *target, f"--out={folder / 'out'}", f"{option}={value}"], capsys)
        assert not (folder / "out").exists()

    check()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("value", ["", "\0", "a\0b", ".", "/", "/dev/null/out", "x" * 300, "y/" * 3000, "link"])
def test_unwritable_out_path_exits_2_with_one_error_line(command, value, inputs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "link")
    target = [inputs[command]] if command in inputs else []
    small = ["--frames=1", "--width=32", "--height=32"] if command == "synthesize" else []
    refused([command, *target, f"--out={value}", *small], capsys)
    assert [entry.name for entry in tmp_path.iterdir()] == ["link"]


@pytest.mark.parametrize("command", ["replay", "reconstruct", "render", "validate"])
@pytest.mark.parametrize(
    "value", ["", "\0", "nowhere", "\udcff", "x" * 300, "/dev/null", "/dev/null/x", "pipe", "loop"]
)
def test_unusable_input_path_exits_2_without_traceback(command, value, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    os.symlink("loop", "loop")
    out = [] if command == "validate" else ["--out", "out"]
    code = run([command, value, *out])
    captured = capsys.readouterr()
    assert code == 2 and "Traceback" not in captured.err
    if command != "validate":
        assert captured.err.count("error: ") == 1 and not (tmp_path / "out").exists()


def test_programming_error_in_operator_exits_1_with_traceback(inputs, tmp_path, monkeypatch, capsys):
    from operators.rasterize import RasterizeOp

    def broken(self, op_input, op_output, context):
        raise InvalidInput("means must be [N, 3], got [3, N]")

    monkeypatch.setattr(RasterizeOp, "compute", broken)
    assert run(["replay", str(inputs["replay"]), "--out", str(tmp_path / "out"), "--steps-per-frame", "1"]) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err and "got [3, N]" in err and "please report it" in err
