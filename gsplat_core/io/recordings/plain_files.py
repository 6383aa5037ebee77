"""Opening the files of a recording: plain files only, and none that a link reaches outside the recording's folder."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from gsplat_core.io.files import open_regular
from gsplat_core.io.recordings.findings import Findings


class UnreadableFile(Exception):
    """Why a file cannot be read; the checks turn it into a finding."""


def open_plain(path: Path) -> BinaryIO:
    """Open a plain file for reading. Raises UnreadableFile for a missing file and for everything that is no plain file."""
    try:
        return open_regular(path)
    except FileNotFoundError as error:
        what = "the link leads to nothing" if os.path.islink(path) else "the file is not there"
        raise UnreadableFile(what) from error
    except OSError as error:
        check_plain(path)
        raise UnreadableFile(f"the file cannot be read: {error.strerror or error}") from error


def check_plain(path: Path) -> None:
    """Raise UnreadableFile for what is no plain file, or is not there."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        raise UnreadableFile("the link leads to nothing" if path.is_symlink() else "the file is not there") from error
    except (OSError, ValueError) as error:
        raise UnreadableFile(f"the file cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(mode):
        raise UnreadableFile("it is not a plain file")


def stays_inside(root: Path, path: Path, findings: Findings) -> bool:
    """Whether `path`, all of its links followed, lies inside the recording's folder; a problem where it does not."""
    if not os.path.lexists(path):
        return True  # what is not there leads nowhere; whoever needs it says that it is missing
    try:
        real = os.path.realpath(path, strict=True)
    except OSError as error:
        reason = "the link leads to nothing" if isinstance(error, FileNotFoundError) else str(error.strerror or error)
        findings.problem(
            path, f"it cannot be read: {reason}", "Copy the file in place of linking it, or remove the link"
        )
        return False
    inside = os.path.realpath(root)
    if os.path.commonpath([real, inside]) != inside:
        findings.problem(path, "it leads out of the recording's folder", "Copy the file in place of linking it")
        return False
    return True


def all_stay_inside(root: Path, files: list[Path], findings: Findings) -> bool:
    """`stays_inside` for files of one folder that has been checked: only those that are links themselves are looked at."""
    return all(stays_inside(root, path, findings) for path in files if path.is_symlink())
