"""Export formats of the service: those for other programs, and the packed model that can be
uploaded again."""

from __future__ import annotations

from collections.abc import Mapping

from gsplat_core.io.exports.formats import FORMATS, ExportFormat, ExportWish
from services.registry.bundle_file import SUFFIX

ISPLAT = ExportFormat("isplat", SUFFIX, "application/octet-stream")
"""Complete model with its deformation, independent of time."""
ALL: Mapping[str, ExportFormat] = {**FORMATS, ISPLAT.name: ISPLAT}


def arguments_of(wish: ExportWish) -> list[str]:
    """Return the command line arguments of the export program."""
    given = {"--time": wish.time_s, "--times": wish.times}
    named = [f"{name}={value!r}" for name, value in given.items() if value is not None]
    return [f"--format={wish.format.name}", *named]
