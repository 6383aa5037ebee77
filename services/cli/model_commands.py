"""Commands of `intrasplat` for finished models. Each command imports its dependencies when it runs."""

from __future__ import annotations

from typing import Annotated

import typer

from services.cli.options import (
    DeviceOption,
    ExportedFileArgument,
    JsonOption,
    MeshArgument,
    ModelArgument,
    PackedFileArgument,
    RendererOption,
    RenderOutOption,
    ScaleOption,
)


def add_to(app: typer.Typer) -> None:
    """Add these commands to the program."""
    for command in (render, pack, export, measure, compare):
        app.command()(command)


def render(
    model: ModelArgument,
    out: RenderOutOption,
    fps: Annotated[float, typer.Option(help="Frames per second of the model's time.")] = 30.0,
    scale: ScaleOption = 1.0,
    device: DeviceOption = "cpu",
    renderer: RendererOption = "alpha",
    view: Annotated[
        str, typer.Option(help="From where: recorded, orbit, stereo (side by side), or a camera path (a .json file).")
    ] = "recorded",
    baseline: Annotated[
        float | None,
        typer.Option(
            help="Distance between the eyes of stereo, in the model's unit.", show_default="0.06 of the depth"
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a video that is there already.")] = False,
    json: JsonOption = False,
) -> int:
    """Render a model over its time window to a video or to images."""
    from operators.applications.render import ViewWish
    from services.cli.render import render_command

    chosen = {"scale": scale, "device": device, "renderer": renderer, "view": ViewWish(view, baseline)}
    return render_command(model, out, fps, overwrite=overwrite, as_json=json, **chosen)


def pack(
    model: ModelArgument,
    file: PackedFileArgument,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")] = False,
    json: JsonOption = False,
) -> int:
    """Pack a model into one file for upload to the service."""
    from services.cli.pack import pack_command

    return pack_command(model, file, overwrite=overwrite, as_json=json)


def export(
    model: ModelArgument,
    file: ExportedFileArgument,
    format: Annotated[
        str | None,
        typer.Option(
            help="ply, splat, glb, ply-sequence; of the surface mesh-ply, mesh-glb, points-ply.",
            show_default="by the file's ending",
        ),
    ] = None,
    time: Annotated[
        float | None, typer.Option(help="Which time of the model, in seconds.", show_default="the end of its window")
    ] = None,
    times: Annotated[
        int | None, typer.Option(help="Of a sequence: how many times of the window.", show_default="30")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there already.")] = False,
    json: JsonOption = False,
) -> int:
    """Export a model for other programs: .ply, .splat, .glb, or a .zip of .ply over time; or its
    surface."""
    from services.cli.export import export_command

    return export_command(model, file, format, time, times, overwrite=overwrite, as_json=json)


def measure(
    model: ModelArgument,
    start: Annotated[str, typer.Option("--from", help="A pixel of the recorded camera's picture, as X,Y.")],
    end: Annotated[
        str | None, typer.Option("--to", help="Another one: the distance, and the length along the surface.")
    ] = None,
    time: Annotated[
        float | None, typer.Option(help="Which time of the model, in seconds.", show_default="the end of its window")
    ] = None,
    json: JsonOption = False,
) -> int:
    """Measure points, distances and lengths on a model's surface, each with its standard error."""
    from services.cli.measure import measure_command

    return measure_command(model, time, start, end, as_json=json)


def compare(
    model: ModelArgument,
    mesh: MeshArgument,
    time: Annotated[
        float | None, typer.Option(help="Which time of the model, in seconds.", show_default="the end of its window")
    ] = None,
    pairs: Annotated[
        str | None,
        typer.Option(
            help="Points that belong together, model = mesh: x,y,z=x,y,z;... Three or more, where they start."
        ),
    ] = None,
    inlier: Annotated[
        float | None,
        typer.Option(help="Distance of an inlier, in the mesh's unit.", show_default="0.02 of the mesh's extent"),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Align a model's surface rigidly to a mesh (.ply, .stl or .obj, for example from CT) and
    report the distances."""
    from services.cli.compare import compare_command

    return compare_command(model, mesh, time, pairs, inlier, as_json=json)
