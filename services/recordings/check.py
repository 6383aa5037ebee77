"""Check of an uploaded recording as a separate program: `python -m services.recordings.check FOLDER --kind KIND --name NAME`.

FOLDER contains the uploaded file `upload`. An archive is unpacked into FOLDER/NAME, after its directory of entries was validated; a video becomes
NAME with its suffix. Then every frame is read, as in `intrasplat validate`. The verdict is one JSON
line: `{"stage": "ready", …}` or `{"stage": "rejected", "reason": …}`. Exit code 0 means that there
is a verdict. The service never imports this module, because it loads OpenCV and the decoders.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import stat
import struct
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from gsplat_core.io.recordings import validate_recording
from services.private_files import keep_files_private
from services.recordings.store import ARCHIVE, MOST_UNPACKED_BYTES, UPLOAD
from services.registry.records import NICENESS, lower_limit, taken_bytes

_REPORTED_FACTS = (
    "layout",
    "frames",
    "frames_damaged",
    "width_px",
    "height_px",
    "fps",
    "duration_s",
    "fields",
    "calibration",
)
MOST_PROBLEMS = 3
CHECK_MEMORY_BYTES = 4 << 30
"""Limit of the memory of the check beyond its libraries, in bytes."""
CHECK_S = 3600.0
"""Limit of the processor time of the check in seconds. Exceeding it rejects the recording."""


def main(arguments: list[str] | None = None) -> int:
    """Check one upload and print the verdict."""
    keep_files_private()
    options = _options(arguments)
    _limit_resources(options.most_bytes)
    path = options.folder / _file_name(options)
    try:
        _put(options, path)
        verdict = _verdict(path, options.folder)
    except ArchiveInvalid as error:
        verdict = {"stage": "rejected", "reason": str(error)}
    except MemoryError:
        verdict = {
            "stage": "rejected",
            "reason": f"it needs more than {CHECK_MEMORY_BYTES} bytes of memory to read",
        }
    sys.stdout.write(json.dumps(verdict, allow_nan=False) + "\n")
    return 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m services.recordings.check", description="Check an uploaded recording."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--kind", required=True, help="archive, or a video's suffix")
    parser.add_argument("--name", required=True, help="original file name")
    parser.add_argument("--most-bytes", type=int, default=MOST_UNPACKED_BYTES, help="largest unpacked size in bytes")
    return parser.parse_args(arguments)


def _limit_resources(most_bytes: int) -> None:
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    lower_limit(resource.RLIMIT_FSIZE, max(most_bytes, 1 << 20))
    lower_limit(resource.RLIMIT_DATA, taken_bytes() + CHECK_MEMORY_BYTES)
    lower_limit(resource.RLIMIT_CPU, int(CHECK_S) + 1, spare=5)


def _file_name(options: argparse.Namespace) -> str:
    return str(options.name) if options.kind == ARCHIVE else f"{options.name}{options.kind}"


def _put(options: argparse.Namespace, path: Path) -> None:
    """Unpack the archive, or link the video, to `path`, after deleting leftovers of an interrupted check."""
    upload = options.folder / UPLOAD
    if options.kind == ARCHIVE:
        shutil.rmtree(path, ignore_errors=True)
        unpack(upload, path, options.most_bytes)
    else:
        path.unlink(missing_ok=True)
        os.link(upload, path)


def _verdict(path: Path, folder: Path) -> dict[str, Any]:
    report = validate_recording(path)
    if report.ok:
        facts = {name: report.facts[name] for name in _REPORTED_FACTS if name in report.facts}
        return {"stage": "ready", **facts, "warnings": len(report.warnings)}
    said = "; ".join(str(problem) for problem in report.problems[:MOST_PROBLEMS])
    more = len(report.problems) - MOST_PROBLEMS
    reason = said.replace(f"{folder}/", "") + (f"; and {more} more" if more > 0 else "")
    return {"stage": "rejected", "reason": reason}


MOST_ENTRIES = 65_000
"""Largest number of files and folders in an archive."""
MOST_RATIO = 100
"""Largest ratio of unpacked to packed size, for files of an archive that unpack to more than 1 MiB."""


MOST_LIST_BYTES = 16 << 20
MOST_PARTS = 5
_END = struct.Struct("<4s4H2LH")
_LOCAL = struct.Struct("<4s5H3L2H")
_ZIP64_LOCATOR_BYTES = 20
_PART = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._ -]{0,99}")
_ENCRYPTED = 0x1 | 0x40 | 0x2000
_PLAIN = (0, stat.S_IFREG, stat.S_IFDIR)
_LEFT_OUT = "__MACOSX"
_OF_A_LAYOUT = {"images", "images_right", "masks", "depth", "segments"}
"""Sub-folder names of a recording. If one of them is the only top folder, it is a part of the recording and not
stripped."""


class ArchiveInvalid(Exception):
    """The archive is refused. The message contains no names, because they may identify a patient."""


@dataclass(frozen=True)
class Entry:
    """File in an archive and its target path inside the folder."""

    info: zipfile.ZipInfo
    path: PurePosixPath


def check_end(file: BinaryIO) -> int:
    """Check that the archive ends with its directory of entries, of limited size, and that no data follows.

    Returns:
        Number of entries.

    Raises:
        ArchiveInvalid: if not, or if the archive is split or of the format zip64.
    """
    size = file.seek(0, 2)
    if size < _END.size:
        raise ArchiveInvalid(f"the archive is cut off: it has {size} bytes")
    file.seek(max(0, size - _END.size - _ZIP64_LOCATOR_BYTES))
    tail = file.read()
    end = tail[-_END.size :]
    kind, disk, list_disk, entries, every, list_bytes, list_at, comment_bytes = _END.unpack(end)
    if kind != b"PK\x05\x06" or comment_bytes:
        raise ArchiveInvalid(
            "the archive is cut off, or something follows its list of files; pack it again without a comment"
        )
    if (
        tail[: -_END.size].startswith(b"PK\x06\x07")
        or 0xFFFF in (entries, every)
        or 0xFFFFFFFF in (list_bytes, list_at)
    ):
        raise ArchiveInvalid(
            "the archive is of the format for over 4 GiB or 65,534 files (zip64); upload a video, or less at once"
        )
    if disk or list_disk or entries != every:
        raise ArchiveInvalid("the archive is one of several parts; pack it into one file")
    if list_bytes > MOST_LIST_BYTES:
        raise ArchiveInvalid(f"the archive's list of files has {list_bytes} bytes; at most {MOST_LIST_BYTES} are read")
    if list_at + list_bytes != size - _END.size:
        raise ArchiveInvalid("the archive's list of files is not where its end says; pack it again")
    return entries


def entries_of(archive: zipfile.ZipFile, file: BinaryIO, stated: int, most_bytes: int) -> list[Entry]:
    """Return the files to unpack, in archive order.

    Raises:
        ArchiveInvalid: if an entry breaks a rule.
    """
    infos = archive.infolist()
    if len(infos) != stated:
        raise ArchiveInvalid(f"the archive lists {len(infos)} files and says that there are {stated}; pack it again")
    if stated > MOST_ENTRIES:
        raise ArchiveInvalid(f"the archive has {stated} files; at most {MOST_ENTRIES} are unpacked")
    for number, info in enumerate(infos):
        _check_entry(info, number)
    whole = sum(info.file_size for info in infos)
    if whole > most_bytes:
        raise ArchiveInvalid(f"the archive holds {whole} bytes; at most {most_bytes} are unpacked")
    _check_places(infos, file, archive.start_dir)
    kept = [Entry(info, PurePosixPath(info.filename)) for info in infos if not info.is_dir() and not _is_left_out(info)]
    return _with_paths_of_their_own(_without_their_common_folder(kept))


def _check_entry(info: zipfile.ZipInfo, number: int) -> None:
    which = f"file {number + 1} of the archive"
    name = info.orig_filename
    parts = name.removesuffix("/").split("/")
    if any(part in ("", ".", "..") for part in parts) or "\\" in name or "\0" in name or ":" in name:
        raise ArchiveInvalid(f"the name of {which} leads out of the recording; pack names like images/000000.png")
    if len(parts) > MOST_PARTS:
        raise ArchiveInvalid(f"{which} lies {len(parts)} folders deep; at most {MOST_PARTS} are unpacked")
    if not _is_left_out(info) and not all(_PART.fullmatch(part) for part in parts):
        raise ArchiveInvalid(
            f"the name of {which} has other signs than letters, digits, dot, dash, underscore and space"
        )
    if stat.S_IFMT(info.external_attr >> 16) not in _PLAIN:
        raise ArchiveInvalid(f"{which} is a link or a device; pack the files themselves")
    if info.flag_bits & _ENCRYPTED:
        raise ArchiveInvalid(f"{which} is encrypted; pack it without a password")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ArchiveInvalid(f"{which} is packed by method {info.compress_type}; use `zip`, which stores and deflates")
    if info.file_size > 1 << 20 and info.file_size > MOST_RATIO * info.compress_size:
        raise ArchiveInvalid(
            f"{which} holds {info.file_size} bytes, packed into {info.compress_size}: over {MOST_RATIO} times as many"
        )


def _check_places(infos: list[zipfile.ZipInfo], file: BinaryIO, list_at: int) -> None:
    """Check that no two entries share bytes of the archive, by which a small archive could unpack to a huge size.
    Raises ArchiveInvalid."""
    end = 0
    for info in sorted(infos, key=lambda each: each.header_offset):
        if info.header_offset < end:
            raise ArchiveInvalid("two files of the archive lie in the same place; pack it again")
        file.seek(info.header_offset)
        head = file.read(_LOCAL.size)
        if len(head) < _LOCAL.size or not head.startswith(b"PK\x03\x04"):
            raise ArchiveInvalid("a file of the archive is not where its list says; pack it again")
        *_, name_bytes, extra_bytes = _LOCAL.unpack(head)
        end = info.header_offset + _LOCAL.size + name_bytes + extra_bytes + info.compress_size
        if end > list_at:
            raise ArchiveInvalid("a file of the archive goes on into the list of files; pack it again")


def _is_left_out(info: zipfile.ZipInfo) -> bool:
    """Return True for an entry that is not unpacked: a hidden file, or the resource folder that macOS adds."""
    parts = info.orig_filename.removesuffix("/").split("/")
    return parts[0] == _LEFT_OUT or any(part.startswith(".") for part in parts)


def _without_their_common_folder(entries: list[Entry]) -> list[Entry]:
    """Strip a common top folder, because often the recording's folder itself was packed; keep one of `_OF_A_LAYOUT`."""
    first = {entry.path.parts[0] for entry in entries}
    if len(first) != 1 or first & _OF_A_LAYOUT or any(len(entry.path.parts) == 1 for entry in entries):
        return entries
    return [Entry(entry.info, PurePosixPath(*entry.path.parts[1:])) for entry in entries]


def _with_paths_of_their_own(entries: list[Entry]) -> list[Entry]:
    if not entries:
        raise ArchiveInvalid("the archive holds no files; pack a recording")
    taken, folders = set(), set()
    for entry in entries:
        name = str(entry.path).casefold()
        if name in taken:
            raise ArchiveInvalid("two files of the archive have the same name, but for capital letters")
        taken.add(name)
        folders |= {str(parent).casefold() for parent in entry.path.parents}
    if taken & folders:
        raise ArchiveInvalid("a file of the archive has the name of a folder in it")
    return entries


PIECE_BYTES = 1 << 20


def unpack(archive: Path, folder: Path, most_bytes: int) -> None:
    """Write the files of `archive` into the new folder `folder`. After an error, files unpacked so far remain.

    Raises:
        ArchiveInvalid: if the archive breaks a rule.
        OSError: if a file cannot be written.
    """
    with open(archive, "rb") as file:
        stated = check_end(file)
        try:
            with zipfile.ZipFile(file) as opened:
                entries = entries_of(opened, file, stated, most_bytes)
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


if __name__ == "__main__":
    sys.exit(main())
