"""Staging of an upload: copied next to the store, measured, hashed, and rejected if it is not a
model archive."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from gsplat_core.errors import BundleError
from gsplat_core.io.files import beside, write_durably
from gsplat_core.io.model_files import open_model_file
from services.errors import Rejected, StoreUnavailable
from services.registry.blobs import PART_SUFFIX
from services.registry.bundle_file import PIECE_BYTES, digest_of, members_of
from services.registry.limits import RegistryLimits


@dataclass(frozen=True)
class StagedUpload:
    """Complete upload on the local disk, with its measurements."""

    path: Path
    size_bytes: int
    digest: str
    manifest_sha256: str
    tensors_sha256: str


def stage(file: Path, incoming: Path, digest: str | None, limits: RegistryLimits) -> StagedUpload:
    """Copy an upload durably into `incoming`, so the caller can no longer change it, and parse its
    container. On errors nothing is left behind.

    Args:
        file: the upload.
        incoming: folder for the copy.
        digest: SHA-256 stated by the sender, in hex, or None.
        limits: budgets of an upload.

    Raises:
        Rejected: if the file is too large, has another digest, or another format.
        StoreUnavailable: if the file cannot be read or the disk is full.
    """
    target = beside(incoming / "upload", PART_SUFFIX)
    copy = _Copy(limits.upload_bytes)
    try:
        try:
            with open_model_file(file) as source:
                write_durably(target, copy.pieces(source))
        except (OSError, BundleError) as error:
            reason = getattr(error, "strerror", None) or error
            raise StoreUnavailable(f"the upload cannot be kept: {reason}; free space, or upload it again") from error
        found = copy.sha256.hexdigest()
        if digest is not None and digest.lower() != found:
            raise Rejected(f"the file has SHA-256 {found}, its sender said {digest[:80]}; upload it again")
        with open(target, "rb") as staged:
            manifest, tensors = members_of(staged, os.fstat(staged.fileno()).st_size)
            return StagedUpload(target, copy.size, found, digest_of(staged, manifest), digest_of(staged, tensors))
    except BaseException:
        target.unlink(missing_ok=True)
        raise


class _Copy:
    """Copy loop that counts bytes against the limit and hashes them."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self.size = 0
        self.sha256 = hashlib.sha256()

    def pieces(self, source: BinaryIO) -> Iterator[bytes]:
        while piece := source.read(PIECE_BYTES):
            self.size += len(piece)
            if self.size > self._most_bytes:
                raise Rejected(
                    f"the file has more than {self._most_bytes} bytes; upload a smaller model, or raise the limit"
                )
            self.sha256.update(piece)
            yield piece
