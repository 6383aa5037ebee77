"""Where a run must not write, whatever name the place is given."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from operators.errors import OutputError
from operators.output_folder import OutputFolder
from operators.output_paths import check_file_path, check_folder_path


@pytest.fixture
def take(tmp_path) -> Path:
    """A recording's folder as far as names go."""
    for folder in ("images", "masks"):
        (tmp_path / "take" / folder).mkdir(parents=True)
        (tmp_path / "take" / folder / "0.png").touch()
    return tmp_path / "take"


@pytest.mark.parametrize("name", ["", ".", "./", "..", "/", "~", "//"])
def test_the_places_where_a_user_lives_are_refused(tmp_path, monkeypatch, name):
    (tmp_path / "home" / "work").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path / "home" / "work")
    with pytest.raises(OutputError, match=r"--out is (the root|your home|empty or the current)"):
        check_folder_path(Path(os.path.expanduser(name)))


def test_links_to_such_places_are_refused_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("/")
    (tmp_path / "here").symlink_to(tmp_path)
    for name in ("link", "here"):
        with pytest.raises(OutputError, match="--out is"):
            check_folder_path(tmp_path / name)


@pytest.mark.parametrize("inside", ["masks", "depth", "images", "images_right", "depth/new", "results", "."])
@pytest.mark.parametrize("link", [False, True])
def test_a_run_does_not_write_into_its_own_recording(take, tmp_path, inside, link):
    (tmp_path / "link").symlink_to(take)
    with pytest.raises(OutputError, match=r"which the run reads|lies inside --out|belongs to the recording"):
        check_folder_path((tmp_path / "link" if link else take) / inside, [take])


@pytest.mark.parametrize("inside", ["depth", "masks", "images_right", "Depth", "depth/a/b"])
def test_nor_among_the_files_of_another_recording(take, inside):
    with pytest.raises(OutputError, match="belongs to the recording"):
        check_folder_path(take / inside)
    with pytest.raises(OutputError, match=r"belongs to the recording|is a recording's folder"):
        check_file_path(take / inside / "film.mp4")


@pytest.mark.parametrize("beside", ["video.mp4", "0001.png", "cameras.json", "recording.json", "poses_bounds.npy"])
def test_every_layout_is_recognised(tmp_path, beside):
    (tmp_path / beside).touch()
    for name in ("depth", "masks", "images_right"):
        with pytest.raises(OutputError, match="belongs to the recording"):
            check_folder_path(tmp_path / name)


def test_a_recording_inside_the_output_folder_is_refused(tmp_path):
    (tmp_path / "out" / "take").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "out" / "take")
    for source in (tmp_path / "out" / "take", tmp_path / "link"):
        with pytest.raises(OutputError, match="lies inside --out"):
            check_folder_path(tmp_path / "out", [source])


def test_a_film_is_not_written_over_its_model_or_into_a_recording(take, tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model.mp4").touch()
    os.link(tmp_path / "model.mp4", tmp_path / "same.mp4")
    with pytest.raises(OutputError, match="which the run reads"):
        check_file_path(tmp_path / "model" / "film.mp4", [tmp_path / "model"])
    with pytest.raises(OutputError, match="is what the command reads"):
        check_file_path(tmp_path / "same.mp4", [tmp_path / "model.mp4"])
    with pytest.raises(OutputError, match="is a recording's folder"):
        check_file_path(take / "film.mp4")


def test_folders_of_our_own_results_are_no_recordings(tmp_path, monkeypatch):
    """A run's folder holds a video, and a rendering may be called images: neither makes the place a recording."""
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
