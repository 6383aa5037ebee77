"""`intrasplat ctl`: snapshots of streams, exports, and the virtual camera."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gsplat_core.io.exports.formats import format_of
from services.cli.ctl import VERSION, ModelName, StreamName
from services.cli.ctl import ctl as ctl
from services.cli.ctl_client import (
    DEFAULT_URL,
    CaOption,
    KeyFileOption,
    OverwriteOption,
    UrlOption,
    check_download,
    print_found,
    with_client,
)
from services.cli.exit_codes import OK
from services.cli.options import ExportedFileArgument, JsonOption
from services.cli.tables import Columns

SNAPSHOT: Columns = {
    "id": "ID", "taken_at": "TAKEN", "seq": "FRAME", "gaussians": "GAUSSIANS", "size_bytes": "SIZE", "pause_ms": "PAUSE MS", "taken_by": "BY",
}  # fmt: skip
FormatOption = Annotated[
    str | None,
    typer.Option(
        help="ply, splat, glb, ply-sequence, mesh-ply, mesh-glb, points-ply or isplat.",
        show_default="by the file's ending",
    ),
]
TimeOption = Annotated[float | None, typer.Option(help="Which time, in seconds.", show_default="the end")]
TimesOption = Annotated[int | None, typer.Option(help="Of a sequence: how many times.", show_default="30")]


def _format(file: Path, given: str | None) -> str:
    if given is None and file.suffix == ".isplat":
        return "isplat"
    return given or format_of(file).name


@ctl.command("snapshot")
def snapshot(
    stream: StreamName,
    model: Annotated[
        str | None, typer.Option(help="Make it the next version of this model.", show_default="keep it as a file")
    ] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    json: JsonOption = False,
) -> int:
    """Take a snapshot of a stream's live model."""

    def act(client: Any) -> Any:
        taken = client.take_snapshot(stream, model)
        return taken if taken.version is None else client.checked(taken.version.name, taken.version.version)

    return print_found([with_client(url, key_file, ca, act)], SNAPSHOT if model is None else VERSION, json)


@ctl.command("snapshots")
def snapshots(
    stream: StreamName,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    json: JsonOption = False,
) -> int:
    """List the stored snapshots of a stream."""
    return print_found(with_client(url, key_file, ca, lambda client: client.snapshots(stream)), SNAPSHOT, json)


@ctl.command("export")
def export(
    name: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    file: ExportedFileArgument,
    format: FormatOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Export a version of a model to a file for other programs."""
    wanted = _format(file, format)
    check_download(file, overwrite)

    def act(client: Any) -> int:
        return client.export_version(name, version, wanted, file, overwrite=overwrite, time_s=time, times=times)

    with_client(url, key_file, ca, act)
    typer.echo(str(file))
    return OK


@ctl.command("fetch")
def fetch(
    stream: StreamName,
    snapshot_id: Annotated[str, typer.Argument(metavar="SNAPSHOT", show_default=False)],
    file: ExportedFileArgument,
    format: FormatOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    overwrite: OverwriteOption = False,
) -> int:
    """Export a snapshot to a file: .isplat, or a format of other programs."""
    wanted = _format(file, format)
    check_download(file, overwrite)

    def act(client: Any) -> int:
        return client.export_snapshot(stream, snapshot_id, wanted, file, overwrite=overwrite, time_s=time, times=times)

    with_client(url, key_file, ca, act)
    typer.echo(str(file))
    return OK


@ctl.command("camera")
def camera(
    stream: StreamName,
    azimuth: Annotated[float, typer.Option(help="Degrees to the right.")] = 0.0,
    elevation: Annotated[float, typer.Option(help="Degrees upwards.")] = 0.0,
    zoom: Annotated[float, typer.Option(help="How many times closer.")] = 1.0,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Move the virtual camera of a stream, the viewpoint of the picture `orbit`."""
    with_client(url, key_file, ca, lambda client: client.turn_camera(stream, azimuth, elevation, zoom))
    return OK
