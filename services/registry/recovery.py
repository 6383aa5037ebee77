"""Recovery at registry start: leftovers of dead processes are deleted, damage is reported only."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from services.registry.blobs import BlobStore, StoredBlob
from services.registry.bundle_file import SUFFIX
from services.registry.records import UNCHECKED, Recovery, State
from services.registry.unpacked import UnpackedModels, folder_name

_log = logging.getLogger(__name__)
_BLOB = re.compile(rf"[0-9a-f]{{64}}-[0-9a-f]{{16}}{re.escape(SUFFIX)}")
"""Format of keys created by this program. Other files in the store are left alone."""

Row = Mapping[Any, Any]


def remove_leftovers(
    rows: Sequence[Row], stored: Sequence[StoredBlob], blobs: BlobStore, incoming: Path, unpacked: UnpackedModels
) -> tuple[str, ...]:
    """Delete incomplete uploads, files without a version, and folders of deleted versions. Called
    under the exclusive lock.

    `stored` was listed before `rows` were read, so a file whose row was added in between is kept.

    Returns:
        Descriptions of the deleted items.
    """
    removed = []
    for path in sorted(incoming.iterdir()):
        path.unlink()
        removed.append(f"half-written upload {path.name}")
    named = {row["blob"] for row in rows}
    for blob in stored:
        if blob.abandoned and blob.key not in named and _BLOB.fullmatch(blob.key):
            blobs.remove(blob.key)
            removed.append(f"upload {blob.key} that no version names")
    removed += [f"unpacked copy {name}" for name in unpacked.remove_others({folder_name(row) for row in rows})]
    for what in removed:
        _log.warning("removed at start: %s", what)
    return tuple(removed)


def findings(
    rows: Sequence[Row], stored: Sequence[StoredBlob], removed: tuple[str, ...], skipped: str | None
) -> Recovery:
    """Report removed items, unchecked versions and damaged files."""
    sizes = {blob.key: blob.size for blob in stored}
    unchecked, damaged = [], []
    for row in rows:
        name, version = row["name"], row["version"]
        if State(row["state"]) in UNCHECKED:
            unchecked.append((name, version))
        size = sizes.get(row["blob"])
        if size != row["size_bytes"]:
            what = "is gone" if size is None else f"has {size} bytes in place of {row['size_bytes']}"
            damaged.append(
                (
                    name,
                    version,
                    f"the stored file of version {version} of model {name!r} {what}; restore it from a backup",
                )
            )
    for *_, sentence in damaged:
        _log.error("%s", sentence)
    if skipped is not None:
        _log.warning("%s", skipped)
    return Recovery(removed, tuple(unchecked), tuple(damaged), skipped)
