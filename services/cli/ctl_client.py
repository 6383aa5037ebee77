"""What the commands of `intrasplat ctl` share: where the service is, its key, and how what it answers is printed."""

from __future__ import annotations

import json as json_format
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from services.cli.exit_codes import OK
from services.cli.streams import printable

if TYPE_CHECKING:
    from pydantic import BaseModel

URL, KEY = "INTRASPLAT_URL", "INTRASPLAT_KEY"
UrlOption = Annotated[str, typer.Option(envvar=URL, help="Where the service is.")]
KeyFileOption = Annotated[
    Path | None,
    typer.Option(help=f"File with an API key; without it the variable {KEY}.", show_default=False),
]
CaOption = Annotated[
    Path | None, typer.Option(help="Certificate of the authority that signed the server's.", show_default=False)
]
DEFAULT_URL = "http://127.0.0.1:8000"


def with_client(url: str, key_file: Path | None, ca: Path | None, act: Callable[[Any], Any]) -> Any:
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


def print_found(found: Sequence[BaseModel], names: Sequence[str], as_json: bool) -> int:
    if as_json:
        typer.echo(json_format.dumps([one.model_dump(mode="json") for one in found], indent=2))
        return OK
    for one in found:
        typer.echo(
            "  ".join(printable(str(value)) for name in names if (value := getattr(one, name)) not in (None, ""))
        )
    return OK
