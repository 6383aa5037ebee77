"""Unpacking of an archive whose directory was accepted."""

from __future__ import annotations

import io
import stat
import zipfile
from types import SimpleNamespace

import pytest

from services.recordings import check as unpacking
from services.recordings.check import ArchiveInvalid


def test_unpack_writes_complete_private_files(tmp_path, monkeypatch):
    monkeypatch.setattr(unpacking, "PIECE_BYTES", 3)
    with zipfile.ZipFile(tmp_path / "upload", "w") as archive:
        archive.writestr("session.json", "{}")
        archive.writestr("images/0001.png", "0123456789")
        archive.writestr("images/0002.png", "")
    unpacking.unpack(tmp_path / "upload", tmp_path / "case", 1 << 20)
    found = {
        str(p.relative_to(tmp_path / "case")): p.read_text() for p in (tmp_path / "case").rglob("*") if p.is_file()
    }
    assert found == {"session.json": "{}", "images/0001.png": "0123456789", "images/0002.png": ""}
    modes = {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "case").rglob("*") if path.is_file()}
    assert modes == {0o600} and stat.S_IMODE((tmp_path / "case").stat().st_mode) == 0o700
    assert stat.S_IMODE((tmp_path / "case" / "images").stat().st_mode) == 0o700


@pytest.mark.parametrize(("stated", "said"), [(9, "longer than its list says"), (11, "is cut off")])
def test_unpack_refuses_file_with_other_length_than_listed(tmp_path, stated, said):
    archive = SimpleNamespace(open=lambda info: io.BytesIO(b"0123456789"))
    entry = SimpleNamespace(path="file", info=SimpleNamespace(file_size=stated))
    with pytest.raises(ArchiveInvalid, match=f"file 8 of the archive .*{said}"):
        unpacking._write(archive, entry, tmp_path, 7)
    assert (tmp_path / "file").stat().st_size <= stated, "nothing beyond the stated length is written"
