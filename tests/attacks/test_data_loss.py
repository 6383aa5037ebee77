"""Outputs that would overwrite inputs or foreign files are refused, and no file changes."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.io.recordings.calibration import write_poses
from operators.errors import OutputError, OutputFolderInUse
from operators.output_folder import OutputFolder, check_file_path, is_own_file
from services.cli.app import run
from services.cli.terminal import BAD_INPUT, OK
from tests.services.registry.made import save_model


def digests_of_files(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def place(tmp_path):
    """A folder with a recording, a model and foreign files."""
    take = tmp_path / "take"
    for name in ("images", "masks", "depth", "images_right"):
        (take / name).mkdir(parents=True)
        (take / name / "0001.png").write_bytes(b"picture")
    for name in ("recording.json", "poses_bounds.npy", "valid_mask.png", "poses.npy"):
        (take / name).write_bytes(b"mine")
    save_model(tmp_path / "model")
    for suffix in ("ply", "splat", "glb", "zip", "isplat", "mp4", "npy", "html", "json", "jsonl"):
        (tmp_path / f"mine.{suffix}").write_bytes(b"mine, and no output of intrasplat")
    (tmp_path / "video.mp4").write_bytes(b"a video")
    os.link(tmp_path / "model" / "model.safetensors", tmp_path / "hard.ply")
    os.link(tmp_path / "model" / "manifest.json", tmp_path / "hard.isplat")
    (tmp_path / "soft.ply").symlink_to(tmp_path / "model" / "model.safetensors")
    (tmp_path / "soft.mp4").symlink_to(tmp_path / "model" / "manifest.json")
    (tmp_path / "into").symlink_to(tmp_path / "model")
    (tmp_path / "sockets").mkdir()
    os.mkfifo(tmp_path / "sockets" / "pipe.ply")
    return tmp_path


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
@pytest.mark.parametrize(
    "arguments",
    [
        ["poses", "take", "--out", "take/poses_bounds.npy"],
        ["poses", "take", "--out", "take/poses.npy"],
        ["poses", "take", "--out", "take/depth/poses.npy"],
        ["poses", "take", "--out", "take/new.npy"],
        ["poses", "take", "--out", "take/images/0001.png"],
        ["poses", "take", "--out", "mine.npy"],
        ["poses", "video.mp4", "--out", "video.mp4"],
        ["poses", "video.mp4", "--out", "./into/../video.mp4"],
        ["export", "model", "model/model.safetensors", "--format", "ply"],
        ["export", "model", "model/new.ply"],
        ["export", "model", "into/new.ply"],
        ["export", "model", "model/manifest.json", "--format", "ply"],
        ["export", "model", "hard.ply"],
        ["export", "model", "soft.ply"],
        ["export", "model", "sockets/pipe.ply"],
        ["export", "model", "take/new.ply"],
        ["export", "model", "take/images/new.ply"],
        ["export", "model", "mine.json", "--format", "ply"],
        *(["export", "model", f"mine.{suffix}"] for suffix in ("ply", "splat", "glb", "zip")),
        ["pack", "model", "hard.isplat"],
        ["pack", "model", "model/new.isplat"],
        ["pack", "model", "take/masks/new.isplat"],
        ["pack", "model", "mine.isplat"],
        ["render", "model", "--out", "mine.mp4"],
        ["render", "model", "--out", "soft.mp4"],
        ["render", "model", "--out", "video.mp4"],
        ["render", "model", "--out", "model/new.mp4"],
        ["render", "model", "--out", "take/new.mp4"],
        ["render", "model", "--out", "take/images_right/new.mp4"],
    ],
    ids=" ".join,
)
def test_commands_do_not_overwrite_foreign_files(place, monkeypatch, capsys, arguments, overwrite):
    monkeypatch.chdir(place)
    before = digests_of_files(place)
    assert run([*arguments, *overwrite]) == BAD_INPUT
    said = capsys.readouterr().err
    assert said.startswith("error: ") and len(said.strip().splitlines()) == 1, said
    assert digests_of_files(place) == before


@pytest.mark.parametrize("name", ["out.ply", "out.splat", "out.glb", "out.zip", "out.isplat"])
def test_pack_and_export_overwrite_own_output_on_request(place, monkeypatch, capsys, name):
    monkeypatch.chdir(place)
    command = ["pack" if name.endswith(".isplat") else "export", "model", name]
    more = ["--times", "2"] if name == "out.zip" else []
    assert run([*command, *more]) == OK
    assert is_own_file(place / name)
    assert run([*command, *more]) == BAD_INPUT
    assert run([*command, *more, "--overwrite"]) == OK


@pytest.mark.parametrize("format_name", ["mesh-ply", "points-ply", "mesh-glb"])
def test_exported_mesh_is_recognised_as_own_file(place, monkeypatch, format_name):
    monkeypatch.chdir(place)
    name = f"out.{format_name[-3:]}"
    code = run(["export", "model", name, "--format", format_name])
    assert code == OK
    assert is_own_file(place / name)


def test_written_poses_are_recognised_as_own_file_and_loadable(tmp_path):
    write_poses(tmp_path / "poses.npy", np.tile(np.eye(4), (3, 1, 1)))
    assert is_own_file(tmp_path / "poses.npy")
    assert np.load(tmp_path / "poses.npy").shape == (3, 4, 4)
    np.save(tmp_path / "truth.npy", np.tile(np.eye(4), (3, 1, 1)))
    assert not is_own_file(tmp_path / "truth.npy")


def test_poses_in_recording_are_overwritten_only_if_own_file(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "0.png").touch()
    out = tmp_path / "poses.npy"
    check_file_path(out, [tmp_path], into_recording=True)
    write_poses(out, np.eye(4)[None])
    check_file_path(out, [tmp_path], into_recording=True, overwrite=True)
    np.save(out, np.eye(4)[None])
    with pytest.raises(OutputError, match="was not written by intrasplat"):
        check_file_path(out, [tmp_path], into_recording=True, overwrite=True)


@pytest.mark.parametrize("name", ["a\0b.ply", "x" * 5000, f"{'x' * 300}.ply"])
def test_check_file_path_refuses_impossible_names(tmp_path, name):
    with pytest.raises(OutputError):
        check_file_path(Path(f"{tmp_path}/{name}"), [tmp_path / "in"])


def _first_run(out: Path) -> None:
    with OutputFolder(out, "replay") as output:
        (output.path / "report.json").write_text("1")
        (output.path / "reconstruction.mp4").write_bytes(bytes(300_000))
        (output.path / "model").mkdir()
        (output.path / "model" / "manifest.json").write_text("1")
        output.publish()


def _second_run(out: Path, during=lambda: None) -> None:
    with OutputFolder(out, "replay") as output:
        (output.path / "report.json").write_text("2")
        (output.path / "model").mkdir()
        (output.path / "model" / "manifest.json").write_text("2")
        during()
        output.publish()


FOREIGN = {
    "a file in the model": lambda out: (out / "model" / "notes.txt").write_text("mine"),
    "a folder in the model": lambda out: (out / "model" / "sub" / "deep").mkdir(parents=True) or (out / "model" / "sub" / "deep" / "x").write_text("mine"),
    "a link in the model": lambda out: (out / "model" / "link").symlink_to("/etc"),
    "another report": lambda out: (out / "report.json").write_text("mine, and longer"),
    "another report of the same length": lambda out: (out / "report.json").write_text("m"),
    "another video of the same length": lambda out: (out / "reconstruction.mp4").write_bytes(b"\1" + bytes(299_999)),
    "another page": lambda out: (out / "report.html").write_text("mine"),
    "a report that is a folder": lambda out: ((out / "report.json").unlink(), (out / "report.json").mkdir(), (out / "report.json" / "x").write_text("mine")),
}  # fmt: skip


@pytest.mark.parametrize("what", FOREIGN)
def test_second_run_refuses_output_folder_with_changed_results(tmp_path, what):
    out = tmp_path / "out"
    _first_run(out)
    FOREIGN[what](out)
    before = digests_of_files(out)
    with pytest.raises(OutputFolderInUse, match="no run of intrasplat wrote"):
        _second_run(out)
    assert digests_of_files(out) == before


@pytest.mark.parametrize("what", [what for what in FOREIGN if what != "another page"])
def test_foreign_files_added_during_second_run_are_kept(tmp_path, what):
    out = tmp_path / "out"
    _first_run(out)
    _second_run(out, lambda: FOREIGN[what](out))
    assert (out / "report.json").read_text() == "2" and (out / "model" / "manifest.json").read_text() == "2"
    kept = [path for path in out.glob("kept-*/**/*") if path.is_file() or path.is_symlink()]
    assert len(kept) == 1
    assert kept[0].is_symlink() or kept[0].stat().st_size == 300_000 or kept[0].read_text().startswith("m")
    _second_run(out)
    assert os.path.lexists(kept[0]), "the next run leaves it alone"


@pytest.mark.parametrize("name", [".run-notes", ".old-photos", ".complete-work", "notes.txt", "recordings"])
def test_second_run_keeps_other_files_in_output_folder(tmp_path, name):
    out = tmp_path / "out"
    _first_run(out)
    (out / name).mkdir()
    (out / name / "x").write_text("mine")
    _second_run(out)
    assert (out / name / "x").read_text() == "mine"


def test_output_folder_of_older_version_is_replaced_if_files_are_known(tmp_path):
    out = tmp_path / "out"
    _first_run(out)
    marker = out / ".intrasplat.json"
    marker.write_text(
        '{"format": "intrasplat-output", "version": 1, "made_by": "replay", "files": ["model", "report.json", "reconstruction.mp4"]}'
    )
    (out / "model" / "notes.txt").write_text("mine")
    with pytest.raises(OutputFolderInUse, match=r"model/notes\.txt"):
        _second_run(out)
    (out / "model" / "notes.txt").unlink()
    _second_run(out)
    assert (out / "report.json").read_text() == "2"
