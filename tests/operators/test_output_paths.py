"""Protected output locations, under every spelling of their path."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from operators.errors import OutputError
from operators.output_folder import OutputFolder, check_file_path, check_folder_path


@pytest.fixture
def take(tmp_path) -> Path:
    """A recording's folder as far as names go."""
    for folder in ("images", "masks"):
        (tmp_path / "take" / folder).mkdir(parents=True)
        (tmp_path / "take" / folder / "0.png").touch()
    return tmp_path / "take"


@pytest.mark.parametrize("name", ["", ".", "./", "..", "/", "~", "//"])
def test_check_folder_path_refuses_root_home_and_current_folder(tmp_path, monkeypatch, name):
    (tmp_path / "home" / "work").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "home" / "work")
    with pytest.raises(OutputError, match=r"--out is (the root|your home|empty or the current)"):
        check_folder_path(Path(os.path.expanduser(name)))


def test_check_folder_path_refuses_links_to_protected_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("/")
    (tmp_path / "here").symlink_to(tmp_path)
    for name in ("link", "here"):
        with pytest.raises(OutputError, match="--out is"):
            check_folder_path(tmp_path / name)


@pytest.mark.parametrize("inside", ["masks", "depth", "images", "images_right", "depth/new", "results", "."])
@pytest.mark.parametrize("link", [False, True])
def test_output_into_own_recording_is_refused(take, tmp_path, inside, link):
    (tmp_path / "link").symlink_to(take)
    with pytest.raises(OutputError, match=r"which the run reads|lies inside --out|belongs to the recording"):
        check_folder_path((tmp_path / "link" if link else take) / inside, [take])


@pytest.mark.parametrize("inside", ["depth", "masks", "images_right", "Depth", "depth/a/b"])
def test_output_into_other_recording_is_refused(take, inside):
    with pytest.raises(OutputError, match="belongs to the recording"):
        check_folder_path(take / inside)
    with pytest.raises(OutputError, match=r"belongs to the recording|is a recording's folder"):
        check_file_path(take / inside / "film.mp4")


@pytest.mark.parametrize("beside", ["video.mp4", "0001.png", "cameras.json", "recording.json", "poses_bounds.npy"])
def test_check_folder_path_recognises_every_recording_layout(tmp_path, beside):
    (tmp_path / beside).touch()
    for name in ("depth", "masks", "images_right"):
        with pytest.raises(OutputError, match="belongs to the recording"):
            check_folder_path(tmp_path / name)


def test_recording_inside_output_folder_is_refused(tmp_path):
    (tmp_path / "out" / "take").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "out" / "take")
    for source in (tmp_path / "out" / "take", tmp_path / "link"):
        with pytest.raises(OutputError, match="lies inside --out"):
            check_folder_path(tmp_path / "out", [source])


def test_video_over_own_model_or_into_recording_is_refused(take, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model.mp4").touch()
    os.link(tmp_path / "model.mp4", tmp_path / "same.mp4")
    with pytest.raises(OutputError, match="which the run reads"):
        check_file_path(tmp_path / "model" / "film.mp4", [tmp_path / "model"])
    with pytest.raises(OutputError, match="is what the command reads"):
        check_file_path(tmp_path / "same.mp4", [tmp_path / "model.mp4"])
    with pytest.raises(OutputError, match="is a recording's folder"):
        check_file_path(take / "film.mp4")


def test_output_path_checks_accept_folders_of_own_results(tmp_path, monkeypatch):
    """A run's video and a rendering named images do not make a folder a recording."""
    monkeypatch.chdir("/")
    for name in ("run", "images"):
        with OutputFolder(tmp_path / name, "replay") as output:
            for result in ("reconstruction.mp4", "000000.png"):
                (output.path / result).touch()
            output.publish()
    check_folder_path(tmp_path / "run" / "images", [tmp_path / "run" / "model"])
    check_folder_path(tmp_path / "run" / "depth")
    check_file_path(tmp_path / "run" / "film.mp4")
    check_file_path(tmp_path / "film.mp4")
    check_folder_path(tmp_path / "images")
    (tmp_path / "film.mp4").touch()
    check_folder_path(tmp_path / "images")


REPORT = '{"series": 1, "outputs": 2, "notes": 3}'


def refused(said, out, *inputs, **options):
    with pytest.raises(OutputError, match=said):
        check_file_path(out, inputs, **options)


def test_check_file_path_overwrites_only_own_files_if_requested(tmp_path):
    out = tmp_path / "a.json"
    check_file_path(out)
    out.write_text(REPORT)
    refused("already exists; give another --to, or --overwrite", out, option="--to")
    check_file_path(out, overwrite=True)
    out.write_text("{}")
    refused("was not written by intrasplat", out, overwrite=True)
    link = tmp_path / "b.json"
    link.symlink_to(out)
    refused("already exists", link)
    out.write_text(REPORT)
    refused("is not a plain file", link, overwrite=True)
    (tmp_path / "gone.json").symlink_to(tmp_path / "nothing")
    refused("is not a plain file", tmp_path / "gone.json", overwrite=True)
    os.mkfifo(tmp_path / "pipe.json")
    refused("is not a plain file", tmp_path / "pipe.json", overwrite=True)


def test_check_file_path_refuses_folder_and_missing_parent(tmp_path):
    refused("is a folder", tmp_path)
    refused("there is no folder .*none to write a.json into", tmp_path / "none" / "a.json")


def test_check_file_path_refuses_input_file(tmp_path):
    source = tmp_path / "model.json"
    source.write_text(REPORT)
    refused("is what the command reads", source, source, overwrite=True)
    recording = tmp_path / "recording"
    (recording / "sub").mkdir(parents=True)
    part = recording / "sub" / "part.json"
    part.write_text(REPORT)
    refused("lies inside .*recording, which the run reads", recording / "new.json", recording)
    linked = tmp_path / "linked.json"
    os.link(part, linked)
    refused("part.json by another name", linked, recording, overwrite=True)
    check_file_path(linked, overwrite=True)  # no input has that other name
    check_file_path(recording / "new.json", [recording], into_recording=True)
    refused("lies inside", recording / "sub" / "new.json", recording, into_recording=True)


@pytest.mark.parametrize(
    "description", ["recording.json", "cameras.json", "poses_bounds.npy", "valid_mask.png", "session.json"]
)
def test_check_file_path_refuses_recording_folder_by_description_file(tmp_path, description):
    (tmp_path / description).write_text("")
    refused(f"is a recording's folder .it holds {description}", tmp_path / "a.ply")
    check_file_path(tmp_path / "a.ply", into_recording=True)


@pytest.mark.parametrize("sidecar", ["images", "masks", "depth", "images_right", "flow"])
def test_check_file_path_refuses_recording_folder_by_picture_subfolder(tmp_path, sidecar):
    (tmp_path / sidecar).mkdir()
    check_file_path(tmp_path / "a.ply")
    (tmp_path / sidecar / "notes.txt").write_text("")
    check_file_path(tmp_path / "a.ply")
    (tmp_path / sidecar / "0001.PNG").write_text("")
    refused(f"is a recording's folder .it holds {sidecar}", tmp_path / "a.ply")
    (tmp_path / sidecar / ".intrasplat.json").write_text("")
    check_file_path(tmp_path / "a.ply")


def test_check_folder_path_refuses_subfolder_of_recording(tmp_path):
    for name in ("views", "masks"):
        (tmp_path / name).mkdir()
        check_folder_path(tmp_path / name / "run")
    (tmp_path / "frame.png").write_text("")
    check_folder_path(tmp_path / "views" / "run")  # next to pictures an unspecific name means nothing
    with pytest.raises(OutputError, match="masks, which belongs to the recording"):
        check_folder_path(tmp_path / "masks" / "run")
    (tmp_path / "recording.json").write_text("")
    with pytest.raises(OutputError, match="views, which belongs to the recording"):
        check_folder_path(tmp_path / "views" / "run")
    (tmp_path / ".intrasplat.json").write_text("")
    check_folder_path(tmp_path / "views" / "run")


def path_of(count):
    """A path of so many bytes."""
    return Path(("/" + "x" * 99) * 40 + "/" + "y" * (count - 4001))


def test_output_path_is_limited_to_4095_bytes(tmp_path):
    refused("there is no folder", path_of(4095))
    refused("is no name that a file can have", path_of(4096))
    check_folder_path(path_of(4095))
    with pytest.raises(OutputError, match="--out has 4096 bytes; a path has at most 4095"):
        check_folder_path(path_of(4096))
    refused("is no name that a file can have", tmp_path / "a\0b")
    refused("cannot be used: File name too long", tmp_path / ("y" * 300))


def test_check_folder_path_refuses_home_root_and_parent_of_input(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    for place, said in (
        (Path("/"), "the root"),
        (tmp_path / "home", "your home folder"),
        (Path(), "the current folder"),
    ):
        with pytest.raises(OutputError, match=said):
            check_folder_path(place)
    check_folder_path(tmp_path / "home" / "run", [tmp_path / "clip.mp4"])
    with pytest.raises(OutputError, match=r"clip\.mp4 lies inside --out"):
        check_folder_path(tmp_path / "run", [tmp_path / "run" / "clip.mp4"])
