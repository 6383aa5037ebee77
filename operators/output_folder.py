"""The folder that a run writes into: a new one, an empty one, or one that an earlier run of ours has left."""

from __future__ import annotations

import json
from pathlib import Path

from operators.errors import OutputFolderInUse
from operators.storage import storage_errors, write_whole

MARKER = ".intrasplat.json"
"""Lies in every folder that this program has made, and only there."""
_FORMAT = "intrasplat-output"


def check_output_folder(folder: Path) -> bool:
    """Whether `folder` holds an earlier run of ours, whose files a new run replaces one by one. Changes nothing.

    Raises OutputFolderInUse for anything else that is not a new or an empty folder.
    """
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise OutputFolderInUse(f"{folder} is a file; give a folder that does not exist yet or is empty")
    try:
        if json.loads((folder / MARKER).read_text(encoding="utf-8")).get("format") == _FORMAT:
            return True
    except (FileNotFoundError, ValueError, AttributeError):
        pass
    others = sorted(entry.name for entry in folder.iterdir())
    if others:
        shown = ", ".join(others[:4]) + (", ..." if len(others) > 4 else "")
        raise OutputFolderInUse(
            f"{folder} is not empty and was not made by intrasplat (it holds {shown}); "
            "choose another --out, so that nothing of yours is overwritten"
        )
    return False


def claim_output_folder(folder: Path, made_by: str) -> bool:
    """Make the folder ours; returns whether an earlier run of ours was there. Raises as `check_output_folder`."""
    earlier = check_output_folder(folder)
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / MARKER, (json.dumps({"format": _FORMAT, "version": 1, "made_by": made_by}) + "\n").encode())
    return earlier
