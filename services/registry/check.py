"""Check of an unpacked model, and conversion of a splat file to a packed model, as a separate program.

`python -m services.registry.check FOLDER --json` loads the bundle with `gsplat_core.io.bundle` (header limits, allowed keys, shapes, types, finite
values), checks it against the budgets, and renders it at its own camera. `python -m services.registry.check FILE TARGET --json` reads a splat file of
another program by its suffix, and makes a static model of it with a camera that shows all of it.

With `--json` each step prints one line: `{"stage": "validated", …}` after the load of a bundle, then `{"stage": "ready", …}` or
`{"stage": "rejected", "reason": …}`. Exit code 0 means that there is a verdict; any other code means that the program itself failed.

The registry never imports this module, because it loads torch. Torch is loaded before the resource limits are set, so
the limits apply to the model alone.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from gsplat_core.errors import BundleCorrupt, BundleError, UnknownFormatVersion, UserError
from gsplat_core.io.bundle import MANIFEST, MAX_MANIFEST_BYTES, load_bundle, parse_manifest, save_bundle
from gsplat_core.io.model_files import open_model_file
from gsplat_core.io.model_sources import load_model
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import new_renderer
from services.private_files import keep_files_private
from services.registry.bundle_file import pack
from services.registry.records import (
    CHECK_MEMORY_BYTES,
    MOST_GAUSSIANS,
    MOST_PIXELS,
    MOST_TENSOR_BYTES,
    limit_resources,
    says_out_of_memory,
)

FAINTEST = 1 / 255
"""Smallest opacity that changes an 8-bit pixel."""


class Unusable(Exception):
    """The model exceeds a budget or cannot be displayed. The message is the reason for the rejection."""


def main(arguments: list[str] | None = None) -> int:
    """Check or convert one upload and print the result. Return the exit code: 0, or 1 if the machine prevented it."""
    keep_files_private()
    options = _options(arguments)
    say = _say_json if options.json else _say_words
    limit_resources(options.device)
    try:
        if options.target is not None:
            say({"stage": "ready", **convert(options.model, options.target)})
        else:
            model = _read(options.model)
            say({"stage": "validated", **_description(model)})
            say({"stage": "ready", **_render(model, options.device)})
    except (BundleCorrupt, UnknownFormatVersion, Unusable) as error:
        folder = options.model if options.target is None else options.model.parent
        say({"stage": "rejected", "reason": str(error).replace(f"{folder}/", "")})
    except UserError as error:
        # The files were intact at unpacking, so the cause is the machine: memory used by other
        # processes, or permissions.
        sys.stderr.write(f"{error}\n")
        return 1
    except torch.OutOfMemoryError as error:  # GPU memory is shared with other processes
        sys.stderr.write(f"{str(error).splitlines()[0]}\n")
        return 1
    except (MemoryError, RuntimeError) as error:
        if not says_out_of_memory(error):
            raise
        what = "check" if options.target is None else "conversion"
        reason = f"it needs more memory than the {CHECK_MEMORY_BYTES} bytes that a {what} may take"
        say({"stage": "rejected", "reason": reason})
    return 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m services.registry.check", description="Check an unpacked model, or convert a splat file."
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help="folder of the model, or splat file")
    parser.add_argument(
        "target", type=Path, nargs="?", metavar="TARGET", help="packed model to write from a splat file"
    )
    parser.add_argument("--json", action="store_true", help="one line of JSON for each step")
    parser.add_argument("--device", default="cpu", help="device of the warm-up render: cpu or cuda")
    return parser.parse_args(arguments)


def _read(folder: Path) -> Model:
    """Load the model after checking its manifest against the budgets.

    Raises:
        BundleError: if the bundle is damaged.
        Unusable: if the model exceeds a budget.
    """
    with open_model_file(folder / MANIFEST, folder) as file:
        manifest = parse_manifest(file.read(MAX_MANIFEST_BYTES + 1), MANIFEST)
    camera = manifest.camera
    for found, most, what in (
        (manifest.count, MOST_GAUSSIANS, "Gaussians"),
        (manifest.tensors_bytes, MOST_TENSOR_BYTES, "bytes of tensors"),
        (camera.width_px * camera.height_px, MOST_PIXELS, f"pixels ({camera.width_px}x{camera.height_px})"),
    ):
        if found > most:
            raise Unusable(f"the model has {found} {what}; at most {most} are allowed here")
    if manifest.count == 0:
        raise Unusable("the model has no Gaussians, so that there is nothing to show")
    return load_bundle(folder)


def _description(model: Model) -> dict[str, Any]:
    return {
        "gaussians": model.gaussians.count,
        "parameters": model.parameter_count,
        "field": None if model.field is None else model.field.kind,
        "renderer": model.trained_by.renderer,
        "width_px": model.camera.width_px,
        "height_px": model.camera.height_px,
        "time_window_s": list(model.time_window_s),
        "model_sha256": model.sha256(),
    }


def _render(model: Model, device: str) -> dict[str, Any]:
    """Render the model at the start, middle and end of its time window.

    Raises:
        Unusable: if a picture is not finite or all pictures are empty.
    """
    start_s, end_s = model.time_window_s
    renderer = new_renderer(model.trained_by.renderer, model.camera, device)
    covered, visible, took_s = 0.0, 0.0, 0.0
    with torch.inference_mode():
        renderer.prepare(model.to(device))
        for time_s in (start_s, (start_s + end_s) / 2, end_s):
            began = time.perf_counter()
            picture = renderer.render(model.camera, time_s).result()
            for name in ("image", "alpha", "depth"):
                values = getattr(picture, name)
                if not bool(torch.isfinite(values).all()):
                    bad = int((~torch.isfinite(values)).sum())
                    raise Unusable(
                        f"the picture at {time_s:g} s has {bad} values of its {name} that are NaN or infinite"
                    )
            visible = max(visible, float(picture.alpha.max()))
            covered = max(covered, float((picture.alpha > 0.5).double().mean()))
            took_s = time.perf_counter() - began
    if visible < FAINTEST:
        raise Unusable(
            "its pictures show nothing at its own camera; look at its Gaussians, its camera and its deformation"
        )
    return {"render_ms": round(1000 * took_s, 1), "covered": round(covered, 4)}


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


def _say_json(line: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(line, allow_nan=False) + "\n")
    sys.stdout.flush()


def _say_words(line: dict[str, Any]) -> None:
    stage = line.pop("stage")
    sys.stdout.write(f"{stage}: {line.get('reason') or ', '.join(f'{name} {value}' for name, value in line.items())}\n")


if __name__ == "__main__":
    sys.exit(main())
