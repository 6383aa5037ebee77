"""Files of two eyes that lie beside each other: `left.mp4` and `right.mp4`, `Left_Image.png` and `Right_Image.png`, `x_L_0100.png` and `x_R_0100.png`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_LEFT = re.compile(r"(?<![a-z])(left|l)(?![a-z])", re.IGNORECASE)
_RIGHT = re.compile(r"(?<![a-z])(right|r)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class Eyes:
    """Files by the eye that their names say."""

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    """As many, each the one of the left file at its place."""
    others: tuple[Path, ...]
    """Of neither eye."""


def split_eyes(files: Sequence[Path]) -> Eyes | None:
    """The files of either eye, in their order; None where there are no pairs, or a file of one eye lacks that of the other."""
    lefts = {_key(_LEFT, path): path for path in files if _LEFT.search(path.stem)}
    rights = {_key(_RIGHT, path): path for path in files if _RIGHT.search(path.stem) and not _LEFT.search(path.stem)}
    if not lefts or lefts.keys() != rights.keys():
        return None
    named = {*lefts.values(), *rights.values()}
    if len(named) != 2 * len(lefts) or len(named) < sum(
        bool(_LEFT.search(p.stem) or _RIGHT.search(p.stem)) for p in files
    ):
        return None
    others = tuple(path for path in files if path not in named)
    return Eyes(tuple(lefts.values()), tuple(rights[key] for key in lefts), others)


def _key(eye: re.Pattern[str], path: Path) -> str:
    return eye.sub("*", path.stem, count=1) + path.suffix
