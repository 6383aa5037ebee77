"""Export or rendering of an unpacked model as a separate program: `python -m services.exports.make FOLDER FILE
--format glb`.

The service never imports this module, because it loads torch, except for `isplat`. Exit code 0: the
file was written. Exit code 2: the export was refused, with the reason on standard error.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

from gsplat_core.errors import UserError
from gsplat_core.io.exports.formats import ExportWish
from operators.settings import RenderOptions
from services.exports.cache import ALL, ISPLAT, PICTURES, RenderWish
from services.private_files import keep_files_private
from services.registry.bundle_file import pack

NICENESS = 10
"""Nice value of an export; running streams have priority."""
REFUSED = 2


def main(arguments: list[str] | None = None) -> int:
    """Create one export file. Return the exit code: 0, or `REFUSED` after a UserError."""
    keep_files_private()
    parser = argparse.ArgumentParser(prog="python -m services.exports.make", description="Export an unpacked model.")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--format", choices=[*ALL, *PICTURES], required=True)
    parser.add_argument("--time", type=float)
    parser.add_argument("--times", type=int)
    parser.add_argument("--render", help="view, time and options of a rendering, as JSON")
    given = parser.parse_args(arguments)
    os.nice(NICENESS)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core file would contain patient data
    try:
        if given.format == ISPLAT.name:
            pack(given.folder, given.file)
        elif given.format in PICTURES:
            wanted = json.loads(given.render)
            options = RenderOptions(**wanted["options"])
            render(
                given.folder, given.file, RenderWish(PICTURES[given.format], options, wanted["view"], wanted["time_s"])
            )
        else:
            export(given.folder, given.file, ExportWish(ALL[given.format], given.time, given.times))
    except UserError as error:
        sys.stderr.write(f"{str(error).replace(f'{given.folder}/', '')}\n")
        return REFUSED
    return 0


def render(folder: Path, file: Path, wish: RenderWish) -> None:
    """Render a picture or a video. Imports here take seconds, and packing does not need them."""
    from operators.applications.render import ViewWish, render_model, render_picture
    from operators.sinks.video import write_png

    options = wish.options
    wanted: dict[str, Any] = {
        "scale": options.scale, "renderer": options.renderer, "options": options.renderer_options,
        "outputs": options.outputs, "view": ViewWish(wish.view),
    }  # fmt: skip
    if wish.format.name == "png":
        write_png(file, render_picture(folder, wish.time_s, **wanted))
    else:
        render_model(folder, file, fps=options.fps, **wanted)


def export(folder: Path, file: Path, wish: ExportWish) -> None:
    """Export to a format of other programs. Imports here take seconds, and packing does not need them."""
    from gsplat_core.io.bundle import load_bundle
    from gsplat_core.io.exports.export import export_model

    export_model(load_bundle(folder), file, wish)


if __name__ == "__main__":
    sys.exit(main())
