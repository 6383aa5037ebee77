"""Conversion of a splat file of another program to a packed model, as a separate program:
`python -m services.registry.convert FILE TARGET --json`.

Reads the file with `gsplat_core.io.model_files`, by its suffix, and makes a static model of it with a camera that shows
all of it. With `--json` one line is printed: `{"stage": "ready", …}` or `{"stage": "rejected", "reason": …}`. Exit code 0
means that there is a result; any other code means that the conversion itself failed.

The registry never imports this module, because it loads torch.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from gsplat_core.errors import BundleCorrupt, BundleError, UnknownFormatVersion, UserError
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.model_sources import load_model
from services.private_files import keep_files_private
from services.registry.bundle_file import pack
from services.registry.records import CHECK_MEMORY_BYTES, MOST_GAUSSIANS, limit_resources, says_out_of_memory


def main(arguments: list[str] | None = None) -> int:
    """Convert one file and print the result. Return the exit code: 0, or 1 if the machine prevented the conversion."""
    keep_files_private()
    parser = argparse.ArgumentParser(prog="python -m services.registry.convert", description="Convert a splat file.")
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("target", type=Path, metavar="TARGET")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    given = parser.parse_args(arguments)
    limit_resources("cpu")
    try:
        line = {"stage": "ready", **convert(given.file, given.target)}
    except (BundleCorrupt, UnknownFormatVersion) as error:
        line = {"stage": "rejected", "reason": str(error).replace(f"{given.file.parent}/", "")}
    except UserError as error:  # the machine is the cause, such as memory used by other processes
        sys.stderr.write(f"{error}\n")
        return 1
    except (MemoryError, RuntimeError) as error:
        if not says_out_of_memory(error):
            raise
        reason = f"it needs more memory than the {CHECK_MEMORY_BYTES} bytes that a conversion may take"
        line = {"stage": "rejected", "reason": reason}
    sys.stdout.write(json.dumps(line) + "\n")
    return 0


def convert(file: Path, target: Path) -> dict[str, Any]:
    """Write the packed model of a splat file.

    Returns:
        Description of the model.

    Raises:
        BundleCorrupt: if the file is no usable splat file, or has too many Gaussians.
        BundleError: if it cannot be read.
    """
    model = load_model(file)
    count = model.gaussians.count
    if count > MOST_GAUSSIANS:
        raise BundleCorrupt(f"{file} has {count} Gaussians; at most {MOST_GAUSSIANS} are allowed here, so prune it")
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        try:
            save_bundle(model, Path(folder) / "model")
        except BundleError as error:
            if isinstance(error.__cause__, BundleCorrupt):  # values that no bundle can have
                raise BundleCorrupt(f"{file} holds values that a model cannot have: {error.__cause__}") from error
            raise
        pack(Path(folder) / "model", target)
    return {"gaussians": count, "sh_degree": model.gaussians.sh_degree}


if __name__ == "__main__":
    sys.exit(main())
