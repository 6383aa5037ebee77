"""Implementation of `intrasplat edit`: change the Gaussians of a model and save it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import typer
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.io.bundle import save_bundle
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import ExportWish, format_of
from gsplat_core.io.model_sources import load_model
from gsplat_core.models.model import Model
from gsplat_core.scene.collection import GaussianCollection
from operators.errors import OutputError
from operators.output_folder import OutputFolder, check_file_path
from services.cli.exit_codes import OK

_SELECTIONS: dict[str, tuple[str, int, Callable[[GaussianCollection, list[float]], Tensor]]] = {
    "box": ("X,Y,Z,X,Y,Z (the corners)", 6, lambda scene, v: scene.in_box(v[:3], v[3:])),
    "sphere": ("X,Y,Z,RADIUS", 4, lambda scene, v: scene.in_sphere(v[:3], v[3])),
    "label": ("NUMBER", 1, lambda scene, v: scene.labelled(_whole(v[0]))),
}
"""Kinds of `--select`: format of the text, number of values, and function that returns the selection."""


@dataclass(frozen=True)
class Edit:
    """Changes of a model, applied in the order of the fields. None or False leaves a change out."""

    select: Sequence[str] = ()
    """Selections `kind:values`; a Gaussian must be in all of them."""
    outside: bool = False
    """Change the Gaussians outside of the selection instead."""
    delete: bool = False
    recolour: str | None = None
    rotate: str | None = None
    """Axis and angle of the rotation as `X,Y,Z,DEGREES`."""
    scale: float | None = None
    translate: str | None = None
    merge: Path | None = None


def edit_command(path: Path, out: Path, edit: Edit, *, overwrite: bool, as_json: bool) -> int:
    """Edit a model, save it and print the path.

    Raises:
        BundleError: if a model cannot be used.
        InvalidSetting: for changes that are invalid or do not fit the model.
        OutputError: if `out` cannot be written.
    """
    wish = ExportWish(format_of(out)) if out.suffix else None
    if wish is not None and (wish.format.is_surface or wish.format.is_sequence):
        raise InvalidSetting(f"{out.name} is not a format of Gaussians; give a folder, or a .ply, .splat or .spz file")
    if wish is not None:
        check_file_path(out, [path], overwrite=overwrite)
    model = load_model(path)
    try:
        edited = edited_model(model, edit)
    except InvalidInput as error:
        raise InvalidSetting(str(error)) from error
    if wish is not None:
        try:
            export_model(edited, out, wish, overwrite=overwrite)
        except OSError as error:
            raise OutputError(
                f"cannot write {out}: {error.strerror or error}; free space or choose another name"
            ) from error
    else:
        with OutputFolder(out, "edit", [path]) as output:
            save_bundle(edited, output.path)
            output.publish()
    counts = {"path": str(out), "gaussians_before": model.gaussians.count, "gaussians": edited.gaussians.count}
    if as_json:
        typer.echo(json.dumps(counts, indent=2))
    else:
        typer.echo(f"{model.gaussians.count} Gaussians before, {edited.gaussians.count} now\n{out}")
    return OK


def edited_model(model: Model, edit: Edit) -> Model:
    """Return the changed model.

    Raises:
        InvalidInput: for a selection or change that is invalid or does not fit the model.
        BundleError: if the model to merge cannot be used.
    """
    scene = GaussianCollection(model.gaussians)
    moves = edit.rotate is not None or edit.scale is not None or edit.translate is not None
    if not (edit.delete or edit.recolour or moves or edit.merge):
        raise InvalidInput("nothing to change; give --delete, --recolour, --rotate, --scale, --translate or --merge")
    if model.field is not None and (moves or edit.merge):
        raise InvalidInput(
            "the model deforms over time, and its motion does not follow; export one time to a .ply file and edit that, or"
            " use --delete and --recolour"
        )
    if edit.delete and not edit.select:
        raise InvalidInput("--delete needs a selection; give --select")
    if edit.delete and (moves or edit.recolour):
        raise InvalidInput("--delete removes what the other options would change; give them in two calls")
    chosen = scene.everything()
    for text in edit.select:
        chosen &= _selected(scene, text)
    if edit.outside:
        chosen = ~chosen
    field = model.field
    if edit.delete:
        scene.delete(chosen)
        if len(scene) == 0:
            raise InvalidInput("the selection holds all Gaussians of the model; --outside selects the others")
        if field is not None and field.capabilities.rows is not None:
            field = field.detached_copy()
            assert field.capabilities.rows is not None
            field.capabilities.rows.select(~chosen)
    if edit.recolour is not None:
        scene.recolour(chosen, colour=_numbers("--recolour", "R,G,B", edit.recolour, 3))
    if moves:
        rotation = None if edit.rotate is None else _rotation(edit.rotate)
        shift = None if edit.translate is None else _numbers("--translate", "X,Y,Z", edit.translate, 3)
        scale = 1.0 if edit.scale is None else edit.scale
        scene.transform(chosen, rotation=rotation, translation=shift, scale=scale)
    if edit.merge is not None:
        other = load_model(edit.merge)
        scene.merge(other.at(other.time_window_s[1]))
    return replace(model, gaussians=scene.gaussians, field=field, unseen_s=None)


def _selected(scene: GaussianCollection, text: str) -> Tensor:
    kind, _, values = text.partition(":")
    if kind not in _SELECTIONS:
        forms = ", ".join(f"{name}:{form}" for name, (form, _, _) in _SELECTIONS.items())
        raise InvalidInput(f"--select {text!r:.80} is none of {forms}")
    form, count, select = _SELECTIONS[kind]
    return select(scene, _numbers(f"--select {kind}", form, values, count))


def _numbers(name: str, form: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise InvalidInput(f"{name} takes {form}, got {text!r:.80}")
    return values


def _whole(value: float) -> int:
    if value != int(value):
        raise InvalidInput(f"--select label takes a whole number, got {value:g}")
    return int(value)


def _rotation(text: str) -> Tensor:
    """Return the matrix [3, 3] of `X,Y,Z,DEGREES`: an axis through the origin and an angle (Rodrigues)."""
    *axis, degrees = _numbers("--rotate", "X,Y,Z,DEGREES", text, 4)
    direction = torch.tensor(axis, dtype=torch.float64)
    if not direction.norm() > 0:
        raise InvalidInput(f"--rotate takes an axis of a length above 0, got {text!r:.80}")
    x, y, z = (direction / direction.norm()).tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
