"""Impossible option values, unusable files and folders of a batch: one error sentence, and no file is lost."""

from __future__ import annotations

import errno
import io
import os

import numpy as np
import pytest

from benchmarks.sparse_points import SparsePoints
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io import files
from gsplat_core.io.files import open_regular, read_regular
from operators.errors import OutputError
from operators.output_folder import check_folder_path
from services.audit import AuditLog
from services.auth import keys as keys_module
from services.cli.app import run
from services.cli.terminal import BAD_INPUT
from services.reports.evaluation import load_evaluated
from tests.services.registry.made import save_model


def is_one_sentence(capsys) -> bool:
    said = capsys.readouterr().err
    errors = [line for line in said.splitlines() if line.startswith("error: ")]
    return len(errors) == 1 and "Traceback" not in said and len(errors[0]) < 900


@pytest.mark.parametrize("time", ["nan", "inf", "-inf", "-1", "1e99", "9" * 400, "1.5"])
@pytest.mark.parametrize(
    "command", [["compare", "model", "mesh.ply"], ["measure", "model", "--from", "8,6"], ["export", "model", "x.ply"]]
)
def test_commands_refuse_time_outside_model_window(tmp_path, monkeypatch, capsys, command, time):
    monkeypatch.chdir(tmp_path)
    save_model(tmp_path / "model")
    # The model has no unit, so that a comparison needs pairs.
    more = ["--pairs", "0,0,0=0,0,0;1,0,0=1,0,0;0,1,0=0,1,0"] if command[0] == "compare" else []
    assert run([*command, *more, f"--time={time}"]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: the ") and ("has seen nothing at" in said or "the time is" in said)
    assert not (tmp_path / "x.ply").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "model", "--out", "x.mp4", "--device=VALUE"],
        ["render", "model", "--out", "x.mp4", "--renderer=VALUE"],
        ["synthesize", "--out", "x", "--scene=VALUE"],
        ["synthesize", "--out", "x", "--frames=VALUE"],
        ["view", "model", "--host=VALUE"],
        ["VALUE"],
        ["export", "model", "x.ply", "--VALUE"],
    ],
    ids=" ".join,
)
def test_error_for_long_value_is_one_short_line(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    assert run([each.replace("VALUE", "x" * 5000) for each in arguments]) == BAD_INPUT
    assert is_one_sentence(capsys)


@pytest.mark.parametrize("option", ["--fps=1e-320", "--fps=0.0001", "--scale=1e-320", "--scale=0.01"])
def test_render_refuses_fps_or_scale_impossible_for_video(tmp_path, monkeypatch, capsys, option):
    monkeypatch.chdir(tmp_path)
    save_model(tmp_path / "model")
    assert run(["render", "model", "--out", "x.mp4", option]) == BAD_INPUT
    assert is_one_sentence(capsys) and not (tmp_path / "x.mp4").exists()


@pytest.mark.parametrize("head", [" ", "AUTO", "x" * 5000, "0" * 63, "é", "\udcff", "0" * 64 + "\n"])
def test_audit_verify_refuses_malformed_head_digest(tmp_path, capsys, head):
    log = AuditLog(tmp_path / "audit.jsonl")
    log.append("model.activate", actor="console", subject="x")
    log.close()
    assert run(["audit", "verify", str(log.path), f"--head={head}"]) == BAD_INPUT
    assert is_one_sentence(capsys)


def test_audit_verify_prints_error_for_changed_log(tmp_path, capsys):
    (tmp_path / "audit.jsonl").write_bytes(b"{}\n")
    assert run(["audit", "verify", str(tmp_path / "audit.jsonl")]) == BAD_INPUT
    assert is_one_sentence(capsys)


def test_read_regular_raises_for_file_that_blocks(tmp_path, monkeypatch):
    """Simulates /proc/kmsg, a regular file by its mode that blocks on read, with a pipe."""
    os.mkfifo(tmp_path / "p")
    writer = os.open(tmp_path / "p", os.O_RDWR)
    monkeypatch.setattr(files.stat, "S_ISREG", lambda mode: True)
    try:
        with pytest.raises(OSError, match="without waiting"):
            read_regular(tmp_path / "p", 100)
        with open_regular(tmp_path / "p") as file, pytest.raises(OSError, match="without waiting"):
            file.read()
    finally:
        os.close(writer)


KINDS = ["pipe", "device", "folder", "dangling link", "empty", "deep", "binary", "huge"]


def place(path, kind: str) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind in ("device", "dangling link"):
        path.symlink_to("/dev/zero" if kind == "device" else "/nowhere")
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    else:
        path.write_bytes({"empty": b"", "deep": b"[" * 100_000, "binary": b"\xff\0" * 100}[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_load_evaluated_refuses_unusable_report_json(tmp_path, kind):
    save_model(tmp_path / "model")
    place(tmp_path / "report.json", kind)
    for path in (tmp_path, tmp_path / "model"):
        with pytest.raises(InvalidSetting, match=r"report\.json"):
            load_evaluated(path)


@pytest.mark.parametrize("kind", KINDS)
def test_sparse_points_refuse_unusable_file(tmp_path, kind):
    place(tmp_path / "sfm_points.npz", kind)
    with pytest.raises(InvalidInput, match=r"sfm_points\.npz cannot be read"):
        SparsePoints.read(tmp_path / "sfm_points.npz")


@pytest.mark.parametrize(
    "points", [np.full((3, 3), np.nan), np.array([["a"] * 3] * 3), np.array([[None] * 3] * 3), np.ones((3, 3), complex)]
)
def test_sparse_points_refuse_non_finite_or_non_numeric_points(tmp_path, points):
    file = io.BytesIO()
    np.savez(file, points=points, obs_point=np.arange(3), obs_frame=np.arange(3))
    (tmp_path / "p.npz").write_bytes(file.getvalue())
    with pytest.raises(InvalidInput, match=r"p\.npz"):
        SparsePoints.read(tmp_path / "p.npz")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_keys_add_on_full_disk_prints_error_and_keeps_keys(tmp_path, monkeypatch, capsys, number):
    def full(_):
        raise OSError(number, os.strerror(number))

    assert run(["keys", "add", "first", "--data", str(tmp_path)]) == 0
    before = (tmp_path / "keys.json").read_bytes()
    capsys.readouterr()
    monkeypatch.setattr(keys_module.os, "fsync", full)
    assert run(["keys", "add", "second", "--data", str(tmp_path)]) == BAD_INPUT
    said = capsys.readouterr()
    assert "keys.json cannot be written" in said.err and "no key was changed" in said.err and not said.out
    assert (tmp_path / "keys.json").read_bytes() == before and not (tmp_path / "keys.new").exists()


@pytest.mark.parametrize("name", ["a", "new"])
def test_check_folder_path_refuses_folder_of_batch(tmp_path, name):
    (tmp_path / "batch.sqlite").touch()
    with pytest.raises(OutputError, match="of the batch in"):
        check_folder_path(tmp_path / name)
