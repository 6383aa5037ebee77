"""Commands of `intrasplat ctl`: client for the service's API.

Order: common options and output; streams and models; snapshots, exports and the virtual camera; recordings and replays; administration.
"""

from __future__ import annotations

import json as json_format
import os
import re
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import format_of
from gsplat_core.io.files import read_regular
from services.cli.options import ExportedFileArgument, JsonOption, path_argument, takes_run_options
from services.cli.terminal import KEY_COLUMNS, OK, Columns, printable, table

if TYPE_CHECKING:
    from pydantic import BaseModel

    from services.client import Client
    from services.schemas import AuditPage, StreamView


URL, KEY, KEY_FILE = "INTRASPLAT_URL", "INTRASPLAT_KEY", "INTRASPLAT_KEY_FILE"
UrlOption = Annotated[str, typer.Option(envvar=URL, help="URL of the service.")]
KeyFileOption = Annotated[
    Path | None,
    typer.Option(
        envvar=KEY_FILE,
        help=f"File with an API key. Default: the file named by {KEY_FILE}, or the key in {KEY}.",
        show_default=False,
    ),
]
CaOption = Annotated[
    Path | None, typer.Option(help="CA certificate that signed the server's certificate (PEM).", show_default=False)
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
MOST_KEY_BYTES = 4096
DEFAULT_URL = "http://127.0.0.1:8000"


@dataclass(frozen=True)
class Service:
    """Address and credentials of the service."""

    url: UrlOption = DEFAULT_URL
    key_file: KeyFileOption = None
    ca: CaOption = None

    def __call__(self, act: Callable[[Any], Any]) -> Any:
        """Call `act` with a client of the service and return its result."""
        from pydantic import ValidationError

        from services.client import Client
        from services.client.requests import not_from_us

        with Client(self.url, _key(self.key_file), verify=str(self.ca) if self.ca else True) as client:
            try:
                return act(client)
            except (ValidationError, KeyError) as error:  # valid JSON, but no answer of the API
                raise not_from_us(self.url, "has unexpected content") from error


def _key(file: Path | None) -> str:
    if file is None:
        if not os.environ.get(KEY):
            raise InvalidSetting(f"there is no API key; give --key-file, or set {KEY_FILE} or {KEY}")
        return os.environ[KEY]
    try:
        return read_regular(file, MOST_KEY_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InvalidSetting(f"{file} cannot be read as a key: {reason}; give a file with one line, the key") from error


def print_found(
    found: Sequence[BaseModel],
    columns: Columns,
    as_json: bool,
    row_of: Callable[[Any], Mapping[str, Any]] = lambda one: one.model_dump(mode="json"),
) -> int:
    """Print records as a table with selected columns, or as JSON with all fields."""
    if as_json:
        typer.echo(json_format.dumps([one.model_dump(mode="json") for one in found], indent=2))
        return OK
    for line in table(columns, [row_of(one) for one in found]):
        typer.echo(line)
    return OK


def check_download(file: Path, overwrite: bool) -> None:
    """Check the target of a download; see `operators.output_folder.check_file_path`.

    Raises:
        OutputError: if the file must not be written.
    """
    from operators.output_folder import check_file_path

    check_file_path(file, overwrite=overwrite)


ctl = typer.Typer(help="Control a running service (`intrasplat serve`).", no_args_is_help=True)
delete = typer.Typer(help="Delete a resource after confirmation.", no_args_is_help=True)
keys = typer.Typer(help="API keys of the service.", no_args_is_help=True)


def command(name: str, group: typer.Typer = ctl) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Register a command. The fields of its parameter `service` become command line options."""
    return lambda function: group.command(name)(takes_run_options(function, "service"))


ModelName = Annotated[str, typer.Argument(metavar="MODEL", show_default=False)]
OptionsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--option",
        metavar="<name=value>",
        help="Option of the engine, as of `intrasplat replay` and `live`; repeat for several.",
        show_default=False,
    ),
]
StreamName = Annotated[str, typer.Argument(metavar="STREAM", show_default=False)]
STREAM: Columns = {
    "name": "STREAM", "state": "STATE", "show": "SHOWS", "capture_hz": "CAMERA/S", "shown_hz": "SHOWN/S", "age_ms": "AGE MS",
    "restarts": "RESTARTS", "displays": "DISPLAYS", "source": "SOURCE", "reason": "REASON",
}  # fmt: skip
VERSION: Columns = {
    "name": "MODEL", "version": "VERSION", "state": "STATE", "size_bytes": "SIZE", "uploaded_at": "UPLOADED", "uploaded_by": "BY",
    "reason": "REASON",
}  # fmt: skip
MODEL: Columns = {"name": "MODEL", "active": "ACTIVE VERSION"}


@command("streams")
def streams(service: Service = Service(), json: JsonOption = False) -> int:
    """List the streams."""
    return print_found(service(lambda client: client.streams()), STREAM, json, stream_row)


@command("start")
def start(name: StreamName, service: Service = Service()) -> int:
    """Start a stream."""
    return print_found([service(lambda client: client.start_stream(name))], STREAM, False, stream_row)


@command("stop")
def stop(name: StreamName, service: Service = Service()) -> int:
    """Stop a stream."""
    return print_found([service(lambda client: client.stop_stream(name))], STREAM, False, stream_row)


@command("options")
def stream_options(name: StreamName, option: OptionsOption = None, service: Service = Service()) -> int:
    """Change options of a stream and print those that are set, as JSON. The affected process restarts. `name=null` restores a default.
    Without --option, nothing changes.
    """
    wanted = assigned(option or ())
    found = service(lambda client: client.set_stream_options(name, wanted) if wanted else client.stream(name))
    typer.echo(json_format.dumps({key: value for key, value in found.options.items() if value is not None}))
    return OK


@command("create")
def create(
    name: StreamName,
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Source address (docs/sources.md).", show_default=False)
    ],
    show: Annotated[str, typer.Option(help="`live`, or `model NAME`.")] = "live",
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    option: OptionsOption = None,
    service: Service = Service(),
) -> int:
    """Create a stream and start it."""
    options = assigned(option or ())

    def act(client: Any) -> Any:
        return client.create_stream(name, source, show=show, device=device, options=options)

    made = service(act)
    return print_found([made], STREAM, False, stream_row)


@command("models")
def models(
    name: Annotated[str | None, typer.Argument(metavar="[MODEL]", show_default=False)] = None,
    service: Service = Service(),
    json: JsonOption = False,
) -> int:
    """List the models, or the versions of one model."""
    if name is None:
        return print_found(service(lambda client: client.models()), MODEL, json)
    return print_found(service(lambda client: client.versions(name)), VERSION, json)


@command("upload")
def upload(
    name: ModelName,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", help="File made by `intrasplat pack`, or a .ply, .splat or .spz file.", show_default=False
        ),
    ],
    service: Service = Service(),
) -> int:
    """Upload a model's next version and wait for its check."""

    def act(client: Any) -> Any:
        made = client.upload(name, file)
        return client.checked(name, made.version)

    found = service(act)
    print_found([found], VERSION, False)
    if found.state == "rejected":
        raise InvalidSetting(f"{name}/{found.version} was rejected: {found.reason}")
    return OK


@command("activate")
def activate(
    name: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    service: Service = Service(),
) -> int:
    """Activate a version in place of the active one."""

    def act(client: Any) -> Any:
        active = {model.name: model.active for model in client.models()}
        return client.activate(name, version, active.get(name))

    return print_found([service(act)], VERSION, False)


@command("rollback")
def rollback(name: ModelName, service: Service = Service()) -> int:
    """Activate the previous version again."""
    return print_found([service(lambda client: client.rollback(name))], VERSION, False)


SNAPSHOT: Columns = {
    "id": "ID", "taken_at": "TAKEN", "seq": "FRAME", "gaussians": "GAUSSIANS", "size_bytes": "SIZE", "pause_ms": "PAUSE MS", "taken_by": "BY",
}  # fmt: skip
FormatOption = Annotated[
    str | None,
    typer.Option(
        help="ply, compressed-ply, splat, spz, glb, ply-sequence, mesh-ply, mesh-glb, points-ply or isplat.",
        show_default="by the file's ending",
    ),
]
TimeOption = Annotated[
    float | None, typer.Option(help="Time within the model's time window, in seconds.", show_default="the end")
]
TimesOption = Annotated[int | None, typer.Option(help="Number of times in a sequence.", show_default="30")]


def _format(file: Path, given: str | None) -> str:
    if given is None and file.suffix == ".isplat":
        return "isplat"
    return given or format_of(file).name


@command("snapshot")
def snapshot(
    stream: StreamName,
    model: Annotated[
        str | None,
        typer.Option(help="Store the snapshot as the next version of this model.", show_default="keep it as a file"),
    ] = None,
    service: Service = Service(),
    json: JsonOption = False,
) -> int:
    """Take a snapshot of a stream's live model."""

    def act(client: Any) -> Any:
        taken = client.take_snapshot(stream, model)
        return taken if taken.version is None else client.checked(taken.version.name, taken.version.version)

    return print_found([service(act)], SNAPSHOT if model is None else VERSION, json)


@command("snapshots")
def snapshots(
    stream: StreamName,
    service: Service = Service(),
    json: JsonOption = False,
) -> int:
    """List the stored snapshots of a stream."""
    return print_found(service(lambda client: client.snapshots(stream)), SNAPSHOT, json)


@command("export")
def export(
    name: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    file: ExportedFileArgument,
    format: FormatOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    service: Service = Service(),
    overwrite: OverwriteOption = False,
) -> int:
    """Export a version of a model to a file for other programs."""
    wanted = _format(file, format)
    check_download(file, overwrite)

    def act(client: Any) -> int:
        return client.export_version(name, version, wanted, file, overwrite=overwrite, time_s=time, times=times)

    service(act)
    typer.echo(str(file))
    return OK


@command("render")
def render(
    name: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    file: Annotated[Path, path_argument("FILE", "A picture (.png) or a video (.mp4).")],
    view: Annotated[str, typer.Option(help="Camera: recorded, orbit or stereo (side by side).")] = "recorded",
    time: TimeOption = None,
    option: OptionsOption = None,
    service: Service = Service(),
    overwrite: OverwriteOption = False,
) -> int:
    """Render a version of a model to a picture or a video, with options of `intrasplat render`."""
    suffix = file.suffix.lower()
    if suffix not in (".png", ".mp4"):
        raise InvalidSetting(f"{file.name} ends in neither .png nor .mp4; give such a name")
    options = assigned(option or ())
    check_download(file, overwrite)

    def act(client: Any) -> int:
        return client.render_version(
            name, version, suffix[1:], file, overwrite=overwrite, view=view, time_s=time, options=options
        )

    service(act)
    typer.echo(str(file))
    return OK


@command("fetch")
def fetch(
    stream: StreamName,
    snapshot_id: Annotated[str, typer.Argument(metavar="SNAPSHOT", show_default=False)],
    file: ExportedFileArgument,
    format: FormatOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    service: Service = Service(),
    overwrite: OverwriteOption = False,
) -> int:
    """Export a snapshot to a file: .isplat, or a format of other programs."""
    wanted = _format(file, format)
    check_download(file, overwrite)

    def act(client: Any) -> int:
        return client.export_snapshot(stream, snapshot_id, wanted, file, overwrite=overwrite, time_s=time, times=times)

    service(act)
    typer.echo(str(file))
    return OK


@command("camera")
def camera(
    stream: StreamName,
    azimuth: Annotated[float, typer.Option(help="Rotation to the right, in degrees.")] = 0.0,
    elevation: Annotated[float, typer.Option(help="Rotation upwards, in degrees.")] = 0.0,
    zoom: Annotated[float, typer.Option(help="Magnification.")] = 1.0,
    service: Service = Service(),
) -> int:
    """Set the position of a stream's virtual camera, from which its `orbit` pictures are rendered."""
    service(lambda client: client.turn_camera(stream, azimuth, elevation, zoom))
    return OK


RECORDING: Columns = {
    "name": "RECORDING", "state": "STATE", "kind": "KIND", "description.frames": "FRAMES", "kept_bytes": "SIZE", "uploaded_at": "UPLOADED",
    "uploaded_by": "BY", "reason": "REASON",
}  # fmt: skip
REPLAY: Columns = {
    "id": "ID", "recording": "RECORDING", "state": "STATE", "frames_done": "DONE", "frames": "FRAMES", "psnr_db": "TRAINING PSNR DB",
    "created_at": "STARTED", "reason": "REASON",
}  # fmt: skip
KEPT: Columns = {"name": "MODEL", "version": "VERSION", "state": "STATE"}
RecordingName = Annotated[str, typer.Argument(metavar="RECORDING", show_default=False)]
ReplayId = Annotated[str, typer.Argument(metavar="REPLAY", help="Id from `ctl replays`.", show_default=False)]


@command("recordings")
def recordings(service: Service = Service(), json: JsonOption = False) -> int:
    """List the uploaded recordings."""
    return print_found(service(lambda client: client.recordings()), RECORDING, json)


@command("add-recording")
def add_recording(
    name: RecordingName,
    path: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="A video, a zip archive, or a recording's folder.", show_default=False),
    ],
    service: Service = Service(),
) -> int:
    """Upload a recording and wait for its check. A folder is packed first."""

    def act(client: Any) -> Any:
        with _packed(path) as file:
            client.upload_recording(name, file)
        return client.checked_recording(name)

    found = service(act)
    print_found([found], RECORDING, False)
    if found.state == "rejected":
        raise InvalidSetting(f"{name} was rejected: {found.reason}")
    return OK


@command("replays")
def replays(
    batch: Annotated[str | None, typer.Option(help="List only replays of this batch.", show_default=False)] = None,
    count: Annotated[int, typer.Option(min=1, max=500, help="Number of replays, newest first.")] = 20,
    service: Service = Service(),
    json: JsonOption = False,
) -> int:
    """Print the newest replays."""
    found = service(lambda client: client.replays(count=count, batch=batch))
    return print_found(found, REPLAY, json)


@command("replay")
def replay(
    names: Annotated[list[str], typer.Argument(metavar="RECORDING...", show_default=False)],
    option: OptionsOption = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the replay has ended.")] = False,
    service: Service = Service(),
) -> int:
    """Start a replay of each given recording."""
    options = assigned(option or ())

    def act(client: Any) -> Any:
        made = client.start_replays(names, options)
        return [client.ended_replay(one) if wait else client.replay(one) for one in made.ids]

    found = service(act)
    print_found(found, REPLAY, False)
    failed = [one for one in found if wait and one.state != "done"]
    if failed:
        raise InvalidSetting(f"{failed[0].recording}: the replay is {failed[0].state}: {failed[0].reason}")
    return OK


@command("cancel")
def cancel(job_id: ReplayId, service: Service = Service()) -> int:
    """Cancel a replay that has not ended."""
    return print_found([service(lambda client: client.cancel_replay(job_id))], REPLAY, False)


@command("result")
def result(
    job_id: ReplayId,
    name: Annotated[
        str, typer.Argument(metavar="FILE", help="Name of the result file, such as report.html.", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option(help="Output file.", show_default="its name, in this folder")] = None,
    service: Service = Service(),
    overwrite: OverwriteOption = False,
) -> int:
    """Download a result file of a replay: report.html, report.json, frames.jsonl, reconstruction.mp4, model.isplat."""
    target = out or Path(Path(name).name)
    check_download(target, overwrite)
    service(lambda client: client.result(job_id, name, target, overwrite=overwrite))
    typer.echo(str(target))
    return OK


@command("keep")
def keep(
    job_id: ReplayId,
    model: ModelName,
    service: Service = Service(),
) -> int:
    """Store a replay's model in the registry, as the next version of a model."""
    found = service(lambda client: client.keep_model(job_id, model))
    return print_found([found], KEPT, False)


@contextmanager
def _packed(path: Path) -> Iterator[Path]:
    """Provide a file, packing a folder into a temporary archive. Nothing is deflated, because
    images are already compressed."""
    if not path.is_dir():
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder) / "recording.zip"
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED, strict_timestamps=False) as opened:
            for file in sorted(each for each in path.rglob("*") if each.is_file()):
                if not file.resolve().is_relative_to(path.resolve()):
                    raise InvalidSetting(f"{file} is a link to a file outside {path}; replace the link by a copy")
                try:
                    opened.write(file, file.relative_to(path))
                except UnicodeEncodeError as error:
                    raise InvalidSetting(f"the name of {str(file)!r} is not valid text; rename it") from error
                except OSError as error:
                    raise InvalidSetting(f"{file} cannot be read: {error.strerror or error}; check it") from error
        yield archive


def assigned(texts: Iterable[str]) -> dict[str, Any]:
    """Parse options of the form `name=value`. Raises InvalidSetting for another form."""
    return dict(_assigned(each) for each in texts)


def _assigned(text: str) -> tuple[str, Any]:
    """Parse `name=value`, with the value as YAML: a number, a boolean or a word."""
    from services.settings import yaml_value

    name, equals, value = text.partition("=")
    if not equals or not name:
        raise InvalidSetting(f"--option {text!r:.80} has no value; write --option name=value")
    try:
        read = yaml_value(value)
        if not isinstance(read, str | int | float | None):
            raise ValueError("it is neither a number nor a word")
        return name.replace("-", "_"), read
    except ValueError as error:
        raise InvalidSetting(
            f"--option {text!r:.80} cannot be read ({error!s:.100}); write a number, true, false or a word"
        ) from error


KeyName = Annotated[
    str,
    typer.Argument(
        metavar="NAME",
        help="Name of the program or place that uses the key. Do not use a person's name.",
        show_default=False,
    ),
]
RoleOption = Annotated[str, typer.Option(help="viewer, operator or admin.")]
ExpiresOption = Annotated[
    float | None, typer.Option(help="Days until the key expires.", show_default="valid until it is revoked")
]
KeyStreamOption = Annotated[
    list[str] | None,
    typer.Option("--stream", metavar="<name>", help="Limit the key to this stream; repeat for several."),
]
YesOption = Annotated[bool, typer.Option("--yes", help="Skip the confirmation.")]
AUDIT: Columns = {
    "seq": "NUMBER", "at": "WHEN", "event": "ACTION", "actor": "BY", "subject": "ON", "outcome": "OUTCOME", "detail": "DETAILS",
}  # fmt: skip
HEALTH: Columns = {"name": "CHECK", "ok": "WELL", "needed": "NEEDED", "detail": "DETAILS"}
MYSELF: Columns = {"name": "NAME", "key_id": "ID", "role": "ROLE", "streams": "STREAMS", "expires_at": "EXPIRES"}
WATCHED: Columns = {
    "name": "STREAM", "state": "STATE", "capture_hz": "CAMERA/S", "shown_hz": "SHOWN/S", "age_ms": "AGE MS",
    "psnr_db": "TRAINING PSNR DB", "previous_psnr_db": "PREVIOUS FRAME DB", "restarts": "RESTARTS", "displays": "DISPLAYS", "reason": "REASON",
}  # fmt: skip
CLEAR = "\x1b[H\x1b[2J"
SPAN = re.compile(r"(\d{1,6})([smhd])", re.ASCII)
UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days"}


def check_sure(what: str, yes: bool) -> None:
    """Ask for confirmation of a deletion.

    Raises:
        InvalidSetting: if it is declined, or there is neither a terminal nor `--yes`.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise InvalidSetting(f"deleting {what} needs a confirmation and standard input is not a terminal; add --yes")
    if not typer.confirm(f"Delete {what}? This cannot be undone.", default=False, err=True):
        raise InvalidSetting("nothing was deleted")


def _deleted(
    service: Service,
    yes: bool,
    what: str,
    find: Callable[[Client], object],
    act: Callable[[Client], None],
) -> int:
    """Delete an existing resource. The lookup comes first, so a mistyped name fails before the confirmation."""

    def show_and_act(client: Client) -> None:
        find(client)
        check_sure(what, yes)
        act(client)

    service(show_and_act)
    typer.echo(f"deleted {what}")
    return OK


@command("stream", delete)
def delete_stream(
    name: StreamName,
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Stop and delete a stream. Its live reconstruction is lost unless a snapshot was taken."""
    return _deleted(service, yes, f"the stream {name}", lambda client: client.stream(name), lambda client: client.delete_stream(name)
    )  # fmt: skip


@command("version", delete)
def delete_version(
    model: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Delete a version of a model. The active version cannot be deleted."""
    return _deleted(service, yes, f"version {version} of the model {model}",
        lambda client: client.version(model, version), lambda client: client.delete_version(model, version),
    )  # fmt: skip


@command("recording", delete)
def delete_recording(
    name: RecordingName,
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Delete a recording that no replay uses."""
    return _deleted(service, yes, f"the recording {name}",
        lambda client: client.recording(name), lambda client: client.delete_recording(name),
    )  # fmt: skip


@command("replay", delete)
def delete_replay(
    job_id: ReplayId,
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Delete an ended replay with its results."""
    return _deleted(service, yes, f"the replay {job_id} and its results",
        lambda client: client.replay(job_id), lambda client: client.delete_replay(job_id),
    )  # fmt: skip


@command("snapshot", delete)
def delete_snapshot(
    stream: StreamName,
    snapshot_id: Annotated[str, typer.Argument(metavar="SNAPSHOT", show_default=False)],
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Delete a snapshot of a stream."""

    def find(client: Client) -> None:
        if all(each.id != snapshot_id for each in client.snapshots(stream)):
            raise InvalidSetting(f"{stream} has no snapshot {snapshot_id!r:.60}; `ctl snapshots {stream}` lists them")

    return _deleted(service, yes, f"the snapshot {snapshot_id} of {stream}",
        find, lambda client: client.delete_snapshot(stream, snapshot_id),
    )  # fmt: skip


@command("list", keys)
def keys_list(service: Service = Service(), json: JsonOption = False) -> int:
    """List the keys, without their secrets."""
    return print_found(service(lambda client: client.keys()), KEY_COLUMNS, json)


@command("add", keys)
def keys_add(
    name: KeyName,
    role: RoleOption = "viewer",
    expires_days: ExpiresOption = None,
    stream: KeyStreamOption = None,
    service: Service = Service(),
) -> int:
    """Create a key and print its token, which is not stored and cannot be shown again."""
    from services.cli.serve import expiry_in

    expires_at = expiry_in(expires_days)
    made = service(lambda client: client.make_key(name, role, expires_at=expires_at, streams=stream or None))
    typer.echo(printable(made.key))
    return OK


@command("revoke", keys)
def keys_revoke(
    key_id: Annotated[str, typer.Argument(metavar="ID", help="Id from `ctl keys list`.", show_default=False)],
    yes: YesOption = False,
    service: Service = Service(),
) -> int:
    """Revoke a key. It is refused from the next request on."""

    def find(client: Client) -> None:
        if all(each.id != key_id for each in client.keys()):  # noqa: SIM118
            raise InvalidSetting(f"there is no key {key_id!r:.60}; `ctl keys list` shows them")

    return _deleted(service, yes, f"the key {key_id}", find, lambda client: client.revoke_key(key_id))


@command("audit")
def audit(
    event: Annotated[
        str | None,
        typer.Option(
            help="Event, such as model.activate, or a prefix such as model for all events of models.",
            show_default=False,
        ),
    ] = None,
    actor: Annotated[str | None, typer.Option(help="Text contained in the actor.", show_default=False)] = None,
    subject: Annotated[str | None, typer.Option(help="Text contained in the subject.", show_default=False)] = None,
    outcome: Annotated[str | None, typer.Option(help="done, refused or failed.", show_default=False)] = None,
    since: Annotated[
        str | None, typer.Option(help="Start: a time, or an age such as 30m, 2h or 7d.", show_default=False)
    ] = None,
    until: Annotated[str | None, typer.Option(help="End: a time, or an age.", show_default=False)] = None,
    count: Annotated[int, typer.Option(min=1, max=500, help="Number of newest entries in the table.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", help="Continue with new entries as they are written.")] = False,
    format: Annotated[
        str, typer.Option(help="table, or all matching entries as jsonl or csv, oldest first.")
    ] = "table",
    service: Service = Service(),
) -> int:
    """Show audit log entries, oldest first."""
    wanted: dict[str, Any] = {
        "event": event, "actor": actor, "subject": subject, "outcome": outcome, "since": moment(since), "until": moment(until),
    }  # fmt: skip
    if format not in ("table", "csv", "jsonl"):
        raise InvalidSetting(f"--format is {format!r:.40}; choose table, csv or jsonl")
    if format != "table":
        if follow:
            raise InvalidSetting("--follow goes with --format table; leave one of them out")

        def save(client: Client) -> None:
            for line in client.export_audit(format, **wanted):
                typer.echo(line)

        service(save)
        return OK
    service(lambda client: _show_audit(client, wanted, count, follow))
    return OK


FOLLOW_S = 2.0


def _show_audit(client: Client, wanted: Mapping[str, Any], count: int, follow: bool) -> None:
    page = _filled(client, wanted, count)
    seen = page.head_seq
    lines = table(AUDIT, [entry.model_dump() for entry in reversed(page.entries)])
    typer.echo("\n".join(lines))
    while follow:
        time.sleep(FOLLOW_S)
        newer = []
        page = client.audit(500, **wanted)
        head = page.head_seq
        while True:
            newer += [entry for entry in page.entries if entry.seq > seen]
            if page.next_before is None or page.next_before <= seen + 1:
                break
            page = client.audit(500, page.next_before, **wanted)
        seen = max(seen, head)
        if newer:
            typer.echo("\n".join(table(AUDIT, [entry.model_dump() for entry in reversed(newer)])[1:]))


def _filled(client: Client, wanted: Mapping[str, Any], count: int) -> AuditPage:
    """Collect up to `count` entries. Several requests may be needed, because the server searches the log in parts."""
    page = first = client.audit(count, **wanted)
    entries = list(page.entries)
    while page.next_before is not None and len(entries) < count:
        page = client.audit(count - len(entries), page.next_before, **wanted)
        entries += page.entries
    return first.model_copy(update={"entries": entries})


def moment(text: str | None) -> datetime | None:
    """Parse a time: ISO 8601, in this machine's zone by default, or a span such as 2h before now; None for None.

    Raises:
        InvalidSetting: if the text is neither.
    """
    if text is None:
        return None
    try:
        if (span := SPAN.fullmatch(text)) is not None:
            return datetime.now(UTC) - timedelta(**{UNITS[span[2]]: int(span[1])})
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidSetting(
            f"{text!r:.60} is no time; write it as 2026-11-23T20:30:00+01:00, or as 30m, 2h or 7d before now"
        ) from error


@command("health")
def health(service: Service = Service(), json: JsonOption = False) -> int:
    """Show each readiness check of the service. Exit code 2 if it is not ready."""
    ready = service(lambda client: client.ready())
    if json:
        typer.echo(ready.model_dump_json(indent=2))
    else:
        rows = [{"name": name, **asdict(check)} for name, check in (ready.checks or {}).items()]
        typer.echo("\n".join([f"the service is {ready.status}", *table(HEALTH, rows)]))
    if ready.status == "not ready":
        raise InvalidSetting("the service is not ready; the checks above say why")
    return OK


@command("whoami")
def whoami(service: Service = Service(), json: JsonOption = False) -> int:
    """Show name, role and limits of the key in use."""
    return print_found([service(lambda client: client.myself())], MYSELF, json)


@command("watch")
def watch(
    stream: Annotated[str | None, typer.Argument(metavar="[STREAM]", show_default=False)] = None,
    every: Annotated[float, typer.Option(min=0.2, max=3600, help="Seconds between two refreshes.")] = 2.0,
    looks: Annotated[
        int | None, typer.Option(min=1, help="Number of refreshes, then exit.", show_default="go on")
    ] = None,
    service: Service = Service(),
) -> int:
    """Show the streams periodically: state, rates, age, restarts and displays. Ends with Ctrl-C."""
    from services.client import ClientError

    def show(client: Client) -> None:
        done = 0
        while True:
            try:
                lines = _status(client, stream)
            except ClientError as error:
                if done == 0:
                    raise
                lines = [f"no answer since the last query: {error}"]
            typer.echo((CLEAR if sys.stdout.isatty() else "") + "\n".join(lines))
            done += 1
            if done == looks:
                return
            time.sleep(every)

    service(show)
    return OK


def _status(client: Client, stream: str | None) -> list[str]:
    streams = client.streams() if stream is None else [client.stream(stream)]
    ready = client.ready()
    unwell = [f"{name}: {check.detail}" for name, check in (ready.checks or {}).items() if not check.ok]
    head = f"{datetime.now().astimezone():%Y-%m-%d %H:%M:%S %z}  {client.url}  {ready.status}"
    return [printable(head), *map(printable, unwell), *table(WATCHED, [stream_row(each) for each in streams])]


def stream_row(stream: StreamView) -> dict[str, Any]:
    """Convert a stream to a table row: frame rates, the newest picture's age and training PSNR,
    restarts and displays."""
    capture, engine = (stream.processes.get(role) or {} for role in ("capture", "engine"))
    figures = engine.get("figures")
    picture = figures.get("picture") if isinstance(figures, Mapping) else None
    shown = picture if isinstance(picture, Mapping) else {}
    restarts = [each["restarts"] for each in (capture, engine) if isinstance(each.get("restarts"), int)]
    return {
        **stream.model_dump(include={"name", "state", "show", "source", "reason"}),
        "capture_hz": _figure(capture.get("rate_hz")),
        "shown_hz": _figure(engine.get("rate_hz")),
        "age_ms": _figure(shown.get("age_ms")),
        "psnr_db": _figure(shown.get("psnr_db")),
        "previous_psnr_db": _figure(shown.get("previous_frame_psnr_db", shown.get("previous_frame_psnr"))),
        "restarts": sum(restarts) if restarts else None,
        "displays": ", ".join(f"{count} {kind}" for kind, count in stream.viewers.items() if count),
    }


def _figure(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


ctl.add_typer(delete, name="delete")
ctl.add_typer(keys, name="keys")
