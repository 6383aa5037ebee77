"""Implementation of `intrasplat pack`."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import typer

from gsplat_core.errors import BundleError
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.manifest import parse_manifest
from operators.errors import OutputError
from operators.output_folder import check_file_path
from services.cli.exit_codes import OK
from services.registry.bundle_file import MANIFEST, PIECE_BYTES, SUFFIX, TENSORS, pack


def pack_command(model: Path, file: Path, *, overwrite: bool, as_json: bool) -> int:
    """Check a model, pack it into one file and print the path.

    Raises:
        BundleError: if the model cannot be used.
        OutputError: if the file cannot be written.
    """
    _check_target(model, file, overwrite)
    load_bundle(model)
    _check_saved_whole(model)
    try:
        size = pack(model, file, overwrite=overwrite)
    except OSError as error:
        raise OutputError(
            f"cannot write {file}: {error.strerror or error}; free space or choose another name"
        ) from error
    if as_json:
        typer.echo(json.dumps({"path": str(file), "bytes": size, "sha256": _sha256(file)}, indent=2))
    else:
        typer.echo(str(file))
    return OK


def _check_target(model: Path, file: Path, overwrite: bool) -> None:
    if file.suffix != SUFFIX:
        raise OutputError(f"{file} does not end in {SUFFIX}; give the packed file a name that does")
    check_file_path(file, [model], overwrite=overwrite, option="FILE")


def _check_saved_whole(model: Path) -> None:
    """Refuse a save that was interrupted between its two renames. Such a bundle loads, but its two
    files do not match."""
    manifest = parse_manifest((model / MANIFEST).read_bytes(), MANIFEST) if (model / MANIFEST).exists() else None
    if manifest is None or manifest.tensors_sha256 != _sha256(model / TENSORS):
        raise BundleError(f"{model} was not saved to its end; load it and save it again before it is packed")


def _sha256(path: Path) -> str:
    sha256 = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(PIECE_BYTES):
            sha256.update(piece)
    return sha256.hexdigest()
