"""Common parts of `intrasplat ctl` commands: address of the service, key, and output."""

from __future__ import annotations

import json as json_format
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular
from services.cli.exit_codes import OK
from services.cli.tables import Columns, table

if TYPE_CHECKING:
    from pydantic import BaseModel

URL, KEY, KEY_FILE = "INTRASPLAT_URL", "INTRASPLAT_KEY", "INTRASPLAT_KEY_FILE"
UrlOption = Annotated[str, typer.Option(envvar=URL, help="Where the service is.")]
KeyFileOption = Annotated[
    Path | None,
    typer.Option(envvar=KEY_FILE, help=f"File with an API key; without one the variable {KEY}.", show_default=False),
]
CaOption = Annotated[
    Path | None, typer.Option(help="Certificate of the authority that signed the server's.", show_default=False)
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace a file that this program has written.")]
MOST_KEY_BYTES = 4096
DEFAULT_URL = "http://127.0.0.1:8000"


def with_client(url: str, key_file: Path | None, ca: Path | None, act: Callable[[Any], Any]) -> Any:
    from pydantic import ValidationError

    from services.client import Client
    from services.client.requests import not_from_us

    with Client(url, _key(key_file), verify=str(ca) if ca else True) as client:
        try:
            return act(client)
        except (ValidationError, KeyError) as error:  # valid JSON, but no answer of the API
            raise not_from_us(url, "is not what this command asked for") from error


def _key(file: Path | None) -> str:
    if file is None:
        if not os.environ.get(KEY):
            raise InvalidSetting(f"there is no API key; give --key-file, or set {KEY_FILE} or {KEY}")
        return os.environ[KEY]
    try:
        return read_regular(file, MOST_KEY_BYTES).decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        said = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InvalidSetting(
            f"{file} cannot be read as a key: {said}; give the file with the one line of a key"
        ) from error


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
