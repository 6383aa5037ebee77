"""Commands of `intrasplat ctl`: client for the service's API."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from services.cli import ctl_admin, ctl_replays
from services.cli.ctl_admin import stream_row
from services.cli.ctl_client import DEFAULT_URL, CaOption, KeyFileOption, UrlOption, print_found, with_client
from services.cli.ctl_replays import OptionsOption, assigned
from services.cli.exit_codes import OK
from services.cli.options import JsonOption
from services.cli.tables import Columns

ctl = typer.Typer(help="Speak to a running service (`intrasplat serve`).", no_args_is_help=True)
ctl_replays.add_to(ctl)
ctl_admin.add_to(ctl)
ModelName = Annotated[str, typer.Argument(metavar="MODEL", show_default=False)]
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


@ctl.command("streams")
def streams(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """List the streams."""
    return print_found(with_client(url, key_file, ca, lambda client: client.streams()), STREAM, json, stream_row)


@ctl.command("start")
def start(name: StreamName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Start a stream."""
    return print_found(
        [with_client(url, key_file, ca, lambda client: client.start_stream(name))], STREAM, False, stream_row
    )


@ctl.command("stop")
def stop(name: StreamName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Stop a stream."""
    return print_found(
        [with_client(url, key_file, ca, lambda client: client.stop_stream(name))], STREAM, False, stream_row
    )


@ctl.command("create")
def create(
    name: StreamName,
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="Its address.", show_default=False)],
    show: Annotated[str, typer.Option(help="`live`, or `model NAME`.")] = "live",
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    option: OptionsOption = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Create a stream and start it."""
    options = assigned(option or ())

    def act(client: Any) -> Any:
        return client.create_stream(name, source, show=show, device=device, options=options)

    made = with_client(url, key_file, ca, act)
    return print_found([made], STREAM, False, stream_row)


@ctl.command("models")
def models(
    name: Annotated[str | None, typer.Argument(metavar="[MODEL]", show_default=False)] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    json: JsonOption = False,
) -> int:
    """List the models, or the versions of one model."""
    if name is None:
        return print_found(with_client(url, key_file, ca, lambda client: client.models()), MODEL, json)
    return print_found(with_client(url, key_file, ca, lambda client: client.versions(name)), VERSION, json)


@ctl.command("upload")
def upload(
    name: ModelName,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Made by `intrasplat pack`.", show_default=False)],
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Upload a model's next version and wait for its check."""

    def act(client: Any) -> Any:
        made = client.upload(name, file)
        return client.checked(name, made.version)

    found = with_client(url, key_file, ca, act)
    print_found([found], VERSION, False)
    if found.state == "rejected":
        raise InvalidSetting(f"{name}/{found.version} was rejected: {found.reason}")
    return OK


@ctl.command("activate")
def activate(
    name: ModelName,
    version: Annotated[int, typer.Argument(min=1, show_default=False)],
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Activate a version in place of the active one."""

    def act(client: Any) -> Any:
        active = {model.name: model.active for model in client.models()}
        return client.activate(name, version, active.get(name))

    return print_found([with_client(url, key_file, ca, act)], VERSION, False)


@ctl.command("rollback")
def rollback(name: ModelName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Activate the previous version again."""
    return print_found([with_client(url, key_file, ca, lambda client: client.rollback(name))], VERSION, False)
