"""Unpacking of an archive after validation of its directory."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path

from services.recordings.archive_list import ArchiveInvalid, Entry, check_end, entries_of
from services.recordings.limits import RecordingLimits

PIECE_BYTES = 1 << 20


def unpack(archive: Path, folder: Path, limits: RecordingLimits) -> None:
    """Write the files of `archive` into the new folder `folder`. After an error, files unpacked so
    far remain.

    Raises:
        ArchiveInvalid: if the archive breaks a rule.
        OSError: if a file cannot be written.
    """
    with open(archive, "rb") as file:
        stated = check_end(file)
        try:
            with zipfile.ZipFile(file) as opened:
                entries = entries_of(opened, file, stated, limits)
                folder.mkdir(mode=0o700)
                for number, entry in enumerate(entries):
                    _write(opened, entry, folder, number)
        except (
            zipfile.BadZipFile,
            zipfile.LargeZipFile,
            zlib.error,
            EOFError,
            NotImplementedError,  # raised by zipfile for unknown compression methods
            ValueError,
        ) as error:
            raise ArchiveInvalid("the archive is damaged; pack and upload it again") from error


def _write(archive: zipfile.ZipFile, entry: Entry, folder: Path, number: int) -> None:
    path = folder / entry.path
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    written = 0
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as target, archive.open(entry.info) as source:
        while piece := source.read(PIECE_BYTES):
            written += len(piece)
            if written > entry.info.file_size:
                raise ArchiveInvalid(f"file {number + 1} of the archive is longer than its list says")
            target.write(piece)
    if written != entry.info.file_size:
        raise ArchiveInvalid(f"file {number + 1} of the archive is cut off")
