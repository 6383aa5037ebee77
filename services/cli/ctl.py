"""`intrasplat ctl`: the service's API from a shell."""

from __future__ import annotations

import json as json_format
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from services.cli.exit_codes import OK
from services.cli.options import JsonOption
from services.cli.streams import printable

if TYPE_CHECKING:
    from pydantic import BaseModel

ctl = typer.Typer(help="Speak to a running service (`intrasplat serve`).", no_args_is_help=True)
URL, KEY = "INTRASPLAT_URL", "INTRASPLAT_KEY"
UrlOption = Annotated[str, typer.Option(envvar=URL, help="Where the service is.")]
KeyFileOption = Annotated[
    Path | None,
    typer.Option(help=f"File with an API key; without it the variable {KEY}.", show_default=False),
]
CaOption = Annotated[
    Path | None, typer.Option(help="Certificate of the authority that signed the server's.", show_default=False)
]
ModelName = Annotated[str, typer.Argument(metavar="MODEL", show_default=False)]
StreamName = Annotated[str, typer.Argument(metavar="STREAM", show_default=False)]
DEFAULT_URL = "http://127.0.0.1:8000"


def _with_client(url: str, key_file: Path | None, ca: Path | None, act: Callable[[Any], Any]) -> Any:
    from services.client import Client

    with Client(url, _key(key_file), verify=str(ca) if ca else True) as client:
        return act(client)


def _key(file: Path | None) -> str:
    if file is None:
        if not os.environ.get(KEY):
            raise InvalidSetting(f"there is no API key; give --key-file, or set {KEY}")
        return os.environ[KEY]
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidSetting(f"{file} cannot be read as a key: {error}") from error


def _print(found: Sequence[BaseModel], names: Sequence[str], as_json: bool) -> int:
    if as_json:
        typer.echo(json_format.dumps([one.model_dump(mode="json") for one in found], indent=2))
        return OK
    for one in found:
        typer.echo(
            "  ".join(printable(str(value)) for name in names if (value := getattr(one, name)) not in (None, ""))
        )
    return OK


STREAM = ("name", "state", "show", "source", "reason")
VERSION = ("name", "version", "state", "size_bytes", "uploaded_by", "reason")


@ctl.command("streams")
def streams(
    url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None, json: JsonOption = False
) -> int:
    """List the streams."""
    return _print(_with_client(url, key_file, ca, lambda client: client.streams()), STREAM, json)


@ctl.command("start")
def start(name: StreamName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Start a stream."""
    return _print([_with_client(url, key_file, ca, lambda client: client.start_stream(name))], STREAM, False)


@ctl.command("stop")
def stop(name: StreamName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Stop a stream."""
    return _print([_with_client(url, key_file, ca, lambda client: client.stop_stream(name))], STREAM, False)


@ctl.command("create")
def create(
    name: StreamName,
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="Its address.", show_default=False)],
    show: Annotated[str, typer.Option(help="`live`, or `model NAME`.")] = "live",
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Make a stream and start it."""
    made = _with_client(url, key_file, ca, lambda client: client.create_stream(name, source, show=show, device=device))
    return _print([made], STREAM, False)


@ctl.command("models")
def models(
    name: Annotated[str | None, typer.Argument(metavar="[MODEL]", show_default=False)] = None,
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
    json: JsonOption = False,
) -> int:
    """List the models, or the versions of one."""
    if name is None:
        return _print(_with_client(url, key_file, ca, lambda client: client.models()), ("name", "active"), json)
    return _print(_with_client(url, key_file, ca, lambda client: client.versions(name)), VERSION, json)


@ctl.command("upload")
def upload(
    name: ModelName,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Made by `intrasplat pack`.", show_default=False)],
    url: UrlOption = DEFAULT_URL,
    key_file: KeyFileOption = None,
    ca: CaOption = None,
) -> int:
    """Upload a model's next version, and wait until it was checked."""

    def act(client: Any) -> Any:
        made = client.upload(name, file)
        return client.checked(name, made.version)

    found = _with_client(url, key_file, ca, act)
    _print([found], VERSION, False)
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
    """Let a version be shown in place of the one that is active now."""

    def act(client: Any) -> Any:
        active = {model.name: model.active for model in client.models()}
        return client.activate(name, version, active.get(name))

    return _print([_with_client(url, key_file, ca, act)], VERSION, False)


@ctl.command("rollback")
def rollback(name: ModelName, url: UrlOption = DEFAULT_URL, key_file: KeyFileOption = None, ca: CaOption = None) -> int:
    """Show the version before again."""
    return _print([_with_client(url, key_file, ca, lambda client: client.rollback(name))], VERSION, False)
