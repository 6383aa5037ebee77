"""Files and folders appear complete or not at all, under temporary names that cannot be predicted for a link attack."""

from __future__ import annotations

import errno
import os

import pytest

from gsplat_core.io import files
from gsplat_core.io.files import PartialFile, PartialFolder, remove_unfinished, write_durably


def test_partial_file_appears_when_complete(tmp_path):
    with PartialFile(tmp_path / "film.mp4") as partial:
        partial.file.write(b"whole")
        assert partial.path.suffix == ".mp4" and not (tmp_path / "film.mp4").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"whole"


def test_partial_file_error_keeps_earlier_file(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"earlier")
    with pytest.raises(RuntimeError), PartialFile(tmp_path / "film.mp4") as partial:
        partial.file.write(b"half")
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"earlier"


@pytest.mark.parametrize("links", [True, False])
def test_partial_file_without_overwrite_keeps_file_created_meanwhile(tmp_path, monkeypatch, links):
    if not links:

        def refuse(*_, **__):
            raise OSError(errno.EPERM, "no hard links here")

        monkeypatch.setattr(os, "link", refuse)
    with pytest.raises(FileExistsError), PartialFile(tmp_path / "film.mp4", overwrite=False) as partial:
        partial.file.write(b"later")
        (tmp_path / "film.mp4").write_bytes(b"earlier")
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == b"earlier"
    with PartialFile(tmp_path / "new.mp4", overwrite=False) as partial:
        partial.file.write(b"new")
    assert (tmp_path / "new.mp4").read_bytes() == b"new" and len(list(tmp_path.iterdir())) == 2


def test_partial_file_replaces_planted_symlink(tmp_path):
    (tmp_path / "diary").write_bytes(b"mine")
    for name in ("a", "b"):
        (tmp_path / name).symlink_to(tmp_path / "diary")
    write_durably(tmp_path / "a", [b"ours"])
    with PartialFile(tmp_path / "b") as partial:
        partial.file.write(b"ours")
    assert (tmp_path / "diary").read_bytes() == b"mine"
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == b"ours"


def test_partial_file_refuses_existing_temporary_name(tmp_path, monkeypatch):
    monkeypatch.setattr(files.secrets, "token_hex", lambda count: "guessed")
    (tmp_path / "diary").write_bytes(b"mine")
    (tmp_path / ".intrasplat-guessed.part.mp4").symlink_to(tmp_path / "diary")
    with pytest.raises(FileExistsError):
        PartialFile(tmp_path / "film.mp4")
    assert (tmp_path / "diary").read_bytes() == b"mine"


def test_partial_file_with_longest_name_respects_umask(tmp_path):
    name = "f" * 251 + ".mp4"
    before = os.umask(0o027)
    try:
        with PartialFile(tmp_path / name) as partial:
            partial.file.write(b"x")
    finally:
        os.umask(before)
    assert (tmp_path / name).stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("exchange", [True, False])
def test_partial_folder_replaces_earlier_folder(tmp_path, monkeypatch, exchange):
    if not exchange:
        monkeypatch.setattr(files, "_exchanged", lambda first, second: False)
    target = tmp_path / "take"
    target.mkdir()
    (target / "old").touch()
    with PartialFolder(target) as partial:
        (partial.path / "new").touch()
        earlier = partial.finish()
    assert [path.name for path in target.iterdir()] == ["new"]
    assert earlier is not None and [path.name for path in earlier.iterdir()] == ["old"]
    assert len(list(tmp_path.iterdir())) == 2


def test_unfinished_partial_folder_is_removed(tmp_path):
    with pytest.raises(RuntimeError), PartialFolder(tmp_path / "take") as partial:
        (partial.path / "half").touch()
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_remove_unfinished_deletes_partial_files_and_folders(tmp_path):
    partial = PartialFile(tmp_path / "film.mp4")
    folder = PartialFolder(tmp_path / "take")
    (folder.path / "half").touch()
    remove_unfinished()
    assert list(tmp_path.iterdir()) == []
    partial.file.close()
