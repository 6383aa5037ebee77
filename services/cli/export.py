"""Implementation of `intrasplat export`."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import ExportWish, format_named, format_of
from gsplat_core.io.model_sources import load_model
from operators.errors import OutputError
from operators.output_folder import check_file_path
from services.cli.exit_codes import OK


def export_command(
    model: Path, file: Path, format_name: str | None, time_s: float | None, times: int | None, *, overwrite: bool,
    as_json: bool,
) -> int:  # fmt: skip
    """Export a model and print the path of the file.

    Raises:
        BundleError: if the model cannot be used.
        InvalidSetting: if an option does not fit.
        ExportError: if the model cannot be exported to the format.
        OutputError: if the file cannot be written.
    """
    wish = ExportWish(format_of(file) if format_name is None else format_named(format_name), time_s, times)
    if file.suffix.lower() != wish.format.suffix:
        raise OutputError(
            f"{file} does not end in {wish.format.suffix}, as a file of the format {wish.format.name} does; give such a name"
        )
    check_file_path(file, [model], overwrite=overwrite, option="FILE")
    loaded = load_model(model)
    try:
        size = export_model(loaded, file, wish, overwrite=overwrite)
    except OSError as error:
        raise OutputError(
            f"cannot write {file}: {error.strerror or error}; free space or choose another name"
        ) from error
    if as_json:
        said = {"path": str(file), "format": wish.format.name, "bytes": size, "gaussians": loaded.gaussians.count}
        typer.echo(json.dumps({**said, "times_s": wish.times_in(loaded.time_window_s)}, indent=2))
    else:
        typer.echo(str(file))
    return OK
