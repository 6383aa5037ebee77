"""Upload format `.isplat`: a model bundle in one file, readable without torch.

The file is an uncompressed POSIX tar archive (ustar) of exactly two regular files, `manifest.json`
and `model.safetensors`, in this order. Tar is readable and writable sequentially, states each size
before the content, and has no second index that could disagree. Member names are compared but never
used as paths. Owner, permission and time fields are ignored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from gsplat_core.io.files import PartialFile, write_durably
from services.errors import Rejected

SUFFIX = ".isplat"
MANIFEST, TENSORS = "manifest.json", "model.safetensors"
MOST_MANIFEST_BYTES = 1 << 20
BLOCK = 512
MOST_END_BYTES = 22 * BLOCK
"""Maximum trailer: two empty blocks, padded by tar programs to a multiple of 20 blocks."""
PIECE_BYTES = 1 << 20

_USTAR = (b"ustar\x0000", b"ustar  \x00")
_OTHER_FORMATS = {
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "compressed with gzip",
    b"BZh": "compressed with bzip2",
    b"\xfd7zXZ": "compressed with xz",
    b"\x28\xb5\x2f\xfd": "compressed with zstd",
    b"\x80\x02": "a pickle",
    b"\x80\x03": "a pickle",
    b"\x80\x04": "a pickle",
    b"\x80\x05": "a pickle",
    b"version https://git-lfs": "a Git LFS pointer, not the file itself",
}
_REMEDY = "make it with `intrasplat pack`"


@dataclass(frozen=True)
class Member:
    """File in the archive: `size` bytes starting at `offset`."""

    name: str
    offset: int
    size: int


def members_of(file: BinaryIO, size: int) -> tuple[Member, Member]:
    """Locate manifest and tensors in an archive by reading its headers.

    Args:
        file: the archive.
        size: its length in bytes.

    Raises:
        Rejected: if the archive has anything but the two files in order: other names, links,
            compression, hidden or missing bytes.
    """
    file.seek(0)
    start = file.read(BLOCK)
    for magic, what in _OTHER_FORMATS.items():
        if start.startswith(magic):
            raise Rejected(f"the file is {what}; {_REMEDY}")
    manifest = _member(start, MANIFEST, 0, size)
    if manifest.size > MOST_MANIFEST_BYTES:
        raise Rejected(
            f"{MANIFEST} has {manifest.size} bytes; at most {MOST_MANIFEST_BYTES} are allowed, so it is not a manifest"
        )
    second = _end_of(file, manifest)
    file.seek(second)
    tensors = _member(file.read(BLOCK), TENSORS, second, size)
    end = _end_of(file, tensors)
    rest = size - end
    if not 2 * BLOCK <= rest <= MOST_END_BYTES or any(file.read(rest)):
        raise Rejected(f"the file does not end after {TENSORS}: {rest} more bytes; {_REMEDY}")
    return manifest, tensors


def read_pieces(file: BinaryIO, member: Member) -> Iterator[bytes]:
    """Yield the bytes of a member in pieces.

    Raises:
        Rejected: if the file ends inside the member.
    """
    file.seek(member.offset)
    left = member.size
    while left:
        piece = file.read(min(left, PIECE_BYTES))
        if not piece:
            raise Rejected(f"the file ends within {member.name}, {left} bytes too early; upload it again")
        left -= len(piece)
        yield piece


def digest_of(file: BinaryIO, member: Member) -> str:
    """Return the SHA-256 of a member in hex.

    Raises:
        Rejected: if the file ends inside the member.
    """
    sha256 = hashlib.sha256()
    for piece in read_pieces(file, member):
        sha256.update(piece)
    return sha256.hexdigest()


def unpack(file: BinaryIO, size: int, folder: Path) -> None:
    """Extract the two files of an archive into a folder, under fixed names.

    Raises:
        Rejected: if the archive is not valid.
        OSError: if a file cannot be written.
    """
    for member, name in zip(members_of(file, size), (MANIFEST, TENSORS), strict=True):
        write_durably(folder / name, read_pieces(file, member))


def pack(folder: Path, target: Path, *, overwrite: bool = False) -> int:
    """Pack the bundle in `folder` into one file. The output is deterministic.

    Returns:
        Size of the file in bytes.

    Raises:
        FileExistsError: if `target` exists and `overwrite` is False.
        OSError: if a file cannot be read or written.
    """
    with PartialFile(target, overwrite=overwrite) as partial:
        for name in (MANIFEST, TENSORS):
            with open(folder / name, "rb") as source:
                _append(partial.file, name, source)
        partial.file.write(bytes(2 * BLOCK))
        return partial.file.tell()


def _append(archive: BinaryIO, name: str, source: BinaryIO) -> None:
    size = source.seek(0, 2)
    source.seek(0)
    archive.write(_header(name, size))
    left = size
    while piece := source.read(min(PIECE_BYTES, left)):
        archive.write(piece)
        left -= len(piece)
    if left or source.read(1):
        raise OSError(f"{name} changed while it was packed; try again")
    archive.write(bytes(-size % BLOCK))


def _header(name: str, size: int) -> bytes:
    """Return a ustar header (POSIX.1-1988) with mode 0644, owner 0 and time 0."""
    if size >= 8**11:
        raise OSError(f"{name} has {size} bytes; an archive holds files below 8 GiB")
    fields = f"{name:\0<100}0000644\0{0:07o}\0{0:07o}\0{size:011o}\0{0:011o}\0{'':8}0{'':\0<100}ustar\x0000"
    block = bytearray(fields.encode().ljust(BLOCK, b"\0"))
    block[148:156] = f"{sum(block):06o}\0 ".encode()
    return bytes(block)


def _member(block: bytes, name: str, start: int, size: int) -> Member:
    """Parse a header that must describe the regular file `name`."""
    if len(block) < BLOCK:
        raise Rejected(f"the file ends where the header of {name} should be; upload it again")
    if block[257:265] not in _USTAR or _octal(block[148:156]) != sum(block[:148]) + 8 * 32 + sum(block[156:]):
        raise Rejected(
            f"the file is not an {SUFFIX} archive: there is no tar header for {name} at byte {start}; {_REMEDY}"
        )
    found = block[:100].split(b"\0", 1)[0]
    kind, prefix = block[156:157], block[345:500].rstrip(b"\0")
    if found != name.encode() or prefix or kind not in (b"0", b"\0"):
        raise Rejected(f"the archive must hold {MANIFEST} and then {TENSORS} as plain files, nothing else; {_REMEDY}")
    length = _octal(block[124:136])
    if length is None or start + BLOCK + length > size:
        raise Rejected(f"the file has {size} bytes, less than its header says for {name}; upload it again")
    return Member(name, start + BLOCK, length)


def _end_of(file: BinaryIO, member: Member) -> int:
    """Return the offset of the next header. The padding must be empty."""
    end = member.offset + member.size
    file.seek(end)
    if any(file.read(-end % BLOCK)):
        raise Rejected(f"there are bytes hidden behind {member.name}; {_REMEDY}")
    return end + -end % BLOCK


def _octal(field: bytes) -> int | None:
    digits = field.strip(b"\0 ")
    return int(digits, 8) if digits and not digits.strip(b"01234567") else None
