"""Implementation of the commands for finished models: `intrasplat render`, `bench`, `pack`, `export`, `measure`, `compare`, `edit` and `view`."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
import typer
from torch import Tensor

from gsplat_core.errors import BundleError, InvalidInput, InvalidSetting
from gsplat_core.geometry.measure import Length, Measurement, SurfacePoint
from gsplat_core.geometry.mesh import mesh_of
from gsplat_core.geometry.registration import ClosestPoints, distances, from_pairs, moved_by, register
from gsplat_core.io.bundle import load_bundle, parse_manifest, save_bundle
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import ExportWish, format_named, format_of
from gsplat_core.io.model_files import open_model_file
from gsplat_core.io.model_sources import load_model, wrong_extent
from gsplat_core.io.surface_files import read_surface
from gsplat_core.machine import in_gib
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import RendererOptions, check_renderer
from gsplat_core.scene.collection import GaussianCollection
from gsplat_core.value_ranges import plain_float
from operators.applications.bench import BenchSettings, bench_model
from operators.applications.render import render_model
from operators.applications.session import check_device
from operators.errors import OutputError
from operators.output_folder import OutputFolder, check_file_path
from operators.settings import RenderOptions
from services.cli.options import check_host
from services.cli.terminal import BAD_INPUT, INTERRUPTED, OK, InterruptRequest, ProgressPrinter
from services.model_view import ModelView, Pictures, PictureView
from services.registry.bundle_file import MANIFEST, PIECE_BYTES, SUFFIX, TENSORS, pack, unpack


def render_command(model: Path, out: Path, options: RenderOptions, *, as_json: bool, **further: Any) -> int:
    """Render a model and print the path of the result. `further` are passed to `render_model`."""
    fps = options.fps
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
        frames = render_model(
            model, out, fps=fps, scale=options.scale, renderer=options.renderer, options=options.renderer_options,
            outputs=options.outputs, progress=progress, stop_requested=interrupt, **further,
        )  # fmt: skip
    if as_json:
        typer.echo(
            json.dumps({"path": str(out), "frames": frames, "fps": fps, "interrupted": interrupt.requested}, indent=2)
        )
    else:
        typer.echo(str(out))
    return INTERRUPTED if interrupt.requested else OK


def bench_command(
    model: Path, settings: BenchSettings, out: Path | None, *, overwrite: bool, as_json: bool
) -> int:  # fmt: skip
    """Measure a renderer on a model and print the figures."""
    with InterruptRequest() as interrupt, ProgressPrinter(quiet=as_json) as progress:
        result = bench_model(
            model, settings, out, overwrite=overwrite, progress=progress, stop_requested=interrupt
        )  # fmt: skip
    if as_json:
        said = {**asdict(result), "options": asdict(settings.options), "interrupted": interrupt.requested}
        typer.echo(json.dumps(said, indent=2))
    else:
        memory = [] if result.device_peak_bytes is None else [f"{in_gib(result.device_peak_bytes)} on the device"]
        memory += [
            f"{in_gib(result.host_peak_bytes)} of the process, {in_gib(result.parameter_bytes)} of them the model"
        ]
        typer.echo(
            f"{result.gaussians} Gaussians of degree {result.sh_degree}, {result.width_px}x{result.height_px} px, {result.renderer} on"
            f" {result.device}, {result.frames} frames\n"
            f"frame: p50 {result.frame_ms_p50:.2f} ms ({result.fps_p50:.1f} frames/s), p99 {result.frame_ms_p99:.2f} ms"
            f" ({result.fps_p99:.1f} frames/s)\n"
            f"loaded in {result.load_s:.1f} s, prepared in {result.prepare_s:.2f} s; peak memory: {', '.join(memory)}"
        )
        if out is not None:
            typer.echo(str(out))
    return INTERRUPTED if interrupt.requested else OK


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
    """Raise BundleError for a bundle whose save was interrupted between its two renames, so that manifest and
    tensors do not match. `load_bundle` accepts such a bundle."""
    manifest = parse_manifest((model / MANIFEST).read_bytes(), MANIFEST) if (model / MANIFEST).exists() else None
    if manifest is None or manifest.tensors_sha256 != _sha256(model / TENSORS):
        raise BundleError(f"{model} was not saved to its end; load it and save it again before it is packed")


def _sha256(path: Path) -> str:
    sha256 = hashlib.sha256()
    with open(path, "rb") as file:
        while piece := file.read(PIECE_BYTES):
            sha256.update(piece)
    return sha256.hexdigest()


def export_command(
    model: Path, file: Path, format_name: str | None, time_s: float | None, times: int | None, *, overwrite: bool,
    as_json: bool,
) -> int:  # fmt: skip
    """Export a model and print the path of the file.

    Raises:
        BundleError: if the model cannot be used.
        InvalidSetting: if an option does not apply to the format or is out of range.
        ExportError: if the model cannot be exported to the format.
        OutputError: if the file cannot be written.
    """
    wish = ExportWish(format_of(file) if format_name is None else format_named(format_name), time_s, times)
    if not file.name.lower().endswith(wish.format.suffix):
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


PIXEL = re.compile(r"\s*(\d+(?:\.\d+)?)\s*,\s*(\d+(?:\.\d+)?)\s*", re.ASCII)


def measure_command(model: Path, time_s: float | None, start: str, end: str | None, *, as_json: bool) -> int:
    """Measure on a model's surface and print the result.

    Raises:
        BundleError: if the model cannot be used.
        InvalidSetting: if a pixel is outside the picture or was never observed.
    """
    loaded = load_model(model)
    time_s = loaded.time_window_s[1] if time_s is None else time_s
    pixels = [pixel_of(text) for text in (start, end) if text is not None]
    measurement = Measurement(loaded, time_s)
    points = [measurement.point(*pixel) for pixel in pixels]
    said: dict[str, Any] = {"time_s": time_s, "unit": measurement.unit, "metric": measurement.metric}
    said["depth_origin"] = None if measurement.origin is None else measurement.origin.name
    said["points"] = [_point(point) for point in points]
    if len(points) == 2:
        said["distance"] = _length(measurement.distance(*points))
        said["along_surface"] = _length(measurement.length_along(*points))
    typer.echo(json.dumps(said, indent=2) if as_json else _text(said))
    return OK


def pixel_of(text: str) -> tuple[float, float]:
    """Parse a pixel "X,Y" (column, row).

    Raises:
        InvalidSetting: if the text is malformed.
    """
    found = PIXEL.fullmatch(text)
    if found is None:
        raise InvalidSetting(f"{text!r:.60} is no pixel; give its column and row, as 120,85")
    return float(found[1]), float(found[2])


def _point(point: SurfacePoint) -> dict[str, Any]:
    return {
        "pixel": list(point.pixel),
        "position": list(point.position),
        "error": point.position_error,
        "depth": point.depth,
        "depth_error": point.depth_error,
        "opacity": point.opacity,
    }


def _length(length: Length) -> dict[str, float]:
    return {"value": length.value, "error": length.error}


def _text(said: dict[str, Any]) -> str:
    unit = "mm" if said["metric"] else "(relative: the model's lengths have no known unit)"
    lines = []
    for point in said["points"]:
        x, y, z = point["position"]
        at = f"({point['pixel'][0]:g}, {point['pixel'][1]:g})"
        lines.append(f"point at {at}: {x:.2f} {y:.2f} {z:.2f}, error {point['error']:.2f} {unit}")
    for name, label in (("distance", "straight"), ("along_surface", "along the surface")):
        if name in said:
            lines.append(f"{label}: {said[name]['value']:.2f} +- {said[name]['error']:.2f} {unit}")
    return "\n".join(lines)


INLIER_SHARE = 0.02
"""Default distance between model and mesh up to which a point is an inlier, as a share of the surface's extent."""
MOST_SIZE_RATIO = 20.0
"""Largest ratio, in either direction, of the extents of model and mesh if they are aligned without point pairs."""
MOST_SCALE = 1.25
"""Largest ratio, in either direction, between the distances of the given points in the mesh and in a model in millimetres."""
LEAST_INLIERS = 0.05
"""Smallest share of points within the inlier distance at which two aligned surfaces count as matching."""


def compare_command(
    model: Path, mesh: Path, time_s: float | None, pairs: str | None, inlier: float | None, *, as_json: bool
) -> int:
    """Align a model's surface to a mesh and print the distances.

    Raises:
        BundleError: if the model cannot be used.
        ExportError: if the model's camera sees no surface.
        InvalidSetting: if the mesh or the pairs cannot be used, or the alignment is ambiguous.
    """
    if inlier is not None and not 0 < inlier < float("inf"):
        raise InvalidSetting(f"the distance of inliers is {inlier:g}; it must be positive")
    loaded = load_model(model)
    if pairs is None and not loaded.metric:
        raise InvalidSetting(
            "the model's lengths have no known unit, so its size relative to the mesh is unknown; give three or more --pairs"
        )
    time_s = loaded.time_window_s[1] if time_s is None else time_s
    loaded.check_time(time_s)
    seen = mesh_of(loaded, time_s)
    surface = ClosestPoints(*read_surface(mesh))
    points = seen.vertices.astype(np.float64)
    if pairs is None:
        initial = None
        _check_sizes(points, surface)
    else:
        model_points, mesh_points = _read_pairs(pairs)
        initial = from_pairs(model_points, mesh_points, with_scale=not loaded.metric)
        if loaded.metric:
            _check_scale(from_pairs(model_points, mesh_points, with_scale=True))
    found = register(points, surface, initial)
    _, summary = distances(moved_by(found.transform, points), surface, inlier or INLIER_SHARE * surface.extent)
    lies_apart = summary.inlier_share < LEAST_INLIERS
    said = {
        "unit": "the mesh's",
        "metric": loaded.metric,
        "time_s": time_s,
        "registration": {**asdict(found), "transform": found.transform.tolist()},
        "signed_distances": asdict(summary),
        "surfaces_match": not lies_apart,
    }
    if as_json:
        typer.echo(json.dumps(said, indent=2))
    else:
        typer.echo(
            f"{summary.points} points, in the mesh's unit: mean {summary.mean:+.3f}, RMSE {summary.rmse:.3f}, half within"
            f" {summary.absolute_p50:.3f}, 90 % within {summary.absolute_p90:.3f}, 95 % within {summary.absolute_p95:.3f};"
            f" {summary.inlier_share:.1%} are closer than {summary.inlier_distance:.3g}"
        )
    if lies_apart:
        typer.echo(
            f"error: the surfaces do not lie on each other: only {summary.inlier_share:.1%} of the points are closer than"
            f" {summary.inlier_distance:.3g}; give --pairs, or check that both have the same unit",
            err=True,
        )
        return BAD_INPUT
    return OK


def _check_sizes(points: np.ndarray, surface: ClosestPoints) -> None:
    """Check that model and mesh have similar extents, within the factor `MOST_SIZE_RATIO`.

    Raises:
        InvalidSetting: if the sizes suggest different units.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not surface.extent / MOST_SIZE_RATIO < extent < surface.extent * MOST_SIZE_RATIO:
        raise InvalidSetting(
            f"the model's surface is {extent:.3g} mm across and the mesh {surface.extent:.3g}, a factor of {surface.extent / max(extent, 1e-300):.3g}:"
            " they cannot have the same unit; export the mesh in millimetres, or give --pairs where the model shows a small part of it"
        )


def _check_scale(with_scale: np.ndarray) -> None:
    """Check that the point pairs have similar distances in the mesh and in a metric model.

    Raises:
        InvalidSetting: if the scales differ.
    """
    scale = float(np.cbrt(np.linalg.det(with_scale[:3, :3])))
    if not 1 / MOST_SCALE < scale < MOST_SCALE:
        raise InvalidSetting(
            f"the pairs are {scale:.3g} times as far from each other in the mesh as in the model, which is in millimetres;"
            " export the mesh in millimetres, or check the pairs"
        )


def _read_pairs(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Parse point pairs "x,y,z=x,y,z; ...".

    Returns:
        Points of the model and of the mesh, float64 [N, 3] each.

    Raises:
        InvalidSetting: if the text is malformed.
    """
    try:
        pairs = [pair.split("=") for pair in text.split(";")]
        values = np.array(
            [[[plain_float(part.strip()) for part in side.split(",")] for side in pair] for pair in pairs]
        )
    except ValueError as error:
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)") from error
    if values.ndim != 3 or values.shape[1:] != (2, 3) or not np.isfinite(values).all():
        raise InvalidSetting(f"the pairs {text!r:.80} cannot be read; give x,y,z=x,y,z;... (model = mesh)")
    return values[:, 0], values[:, 1]


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
    if not chosen.any():
        low, high = (
            [round(value, 3) for value in of(model.gaussians.means, 0).tolist()] for of in (torch.amin, torch.amax)
        )
        raise InvalidInput(
            f"{'the outside of ' if edit.outside else ''}the selection holds none of the {len(scene)} Gaussians; they are at"
            f" {low} to {high}"
        )
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
    if moves and (wrong := wrong_extent(scene.gaussians)) is not None:
        raise InvalidInput(f"the edited model {wrong}; change --scale or --translate")
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
        values = [plain_float(part.strip()) for part in text.split(",")]
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


def view_command(
    model: Path, host: str, port: int, *, plaintext: bool, renderer: str | None, options: RendererOptions, device: str
) -> int:
    """Serve a model to browsers until interrupted: as Gaussians, or as pictures of a renderer."""
    check_host(host, plaintext, "the viewer has no keys and shows the model to every client")
    if renderer is None and (options.changed() or device != "cpu"):
        raise InvalidSetting("the browser draws the model without a renderer; give --renderer with its options")
    if renderer is not None:
        check_device(device)
        check_renderer(renderer, device, options=options)
    with bundle_in(model) as folder:
        loaded = load_model(folder)
    with InterruptRequest() as interrupt, _server(loaded, host, port, renderer, options, device) as view:
        print(f"the model is on http://{view.address[0]}:{view.address[1]}/", file=sys.stderr, flush=True)  # noqa: T201
        view.run(interrupt)
    return OK


def _server(
    model: Model, host: str, port: int, renderer: str | None, options: RendererOptions, device: str
) -> ModelView | PictureView:
    if renderer is None:
        return ModelView(model, host, port)
    pictures = Pictures(model.to(device), renderer, options, device)
    return PictureView(pictures, model.time_window_s, host, port)


@contextmanager
def bundle_in(model: Path) -> Iterator[Path]:
    """Provide the folder of a model, unpacking a packed model temporarily.

    Raises:
        BundleError: if the model cannot be read.
        Rejected: if the packed model is not valid.
    """
    if model.suffix != SUFFIX or model.is_dir():
        yield model
        return
    with TemporaryDirectory(prefix="intrasplat-view-") as folder:
        try:
            with open_model_file(model) as file:
                unpack(file, os.fstat(file.fileno()).st_size, Path(folder))
        except OSError as error:
            raise BundleError(f"{model} cannot be read: {error.strerror or error}; check the name") from error
        yield Path(folder)
