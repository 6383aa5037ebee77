"""Implementation of `intrasplat igtl`, and the check of listen addresses for servers without keys or encryption."""

from __future__ import annotations

import ipaddress
import json
import sys
from pathlib import Path

import typer

from gsplat_core.errors import InvalidSetting
from services.cli.exit_codes import OK
from services.cli.terminal import InterruptRequest
from services.display.hub import KINDS
from services.openigtlink import MessageServer, StreamMessages, folder_of, send
from services.settings import load_settings


def check_host(host: str, plaintext: bool, why: str) -> None:
    """Check that an address is a loopback address, unless `plaintext` is set.

    Args:
        host: address to listen on.
        plaintext: allow other addresses.
        why: explanation for the error message.

    Raises:
        InvalidSetting: if the address is reachable from other machines.
    """
    try:
        here = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        here = False
    if not here and not plaintext:
        raise InvalidSetting(
            f"{host} is beyond this machine: {why}; give --plaintext on a network that is closed to others"
        )


def igtl_command(
    stream: str, config: Path | None, runtime: Path | None, *, kind: str, host: str, port: int, name: str | None,
    spacing_mm: float, plaintext: bool,
) -> int:  # fmt: skip
    """Send a stream's pictures to OpenIGTLink clients until interrupted."""
    if kind not in KINDS:
        raise InvalidSetting(f"there is no picture {kind!r:.60}; choose {', '.join(KINDS)}")
    check_host(host, plaintext, "OpenIGTLink has no keys and sends unencrypted pictures to every client")
    folder = folder_of(runtime or load_settings(config, {}).runtime_dir, stream)
    messages = StreamMessages(name or stream[:13], spacing_mm)
    server = MessageServer(host, port)
    try:
        with InterruptRequest() as interrupt:
            print(f"OpenIGTLink server on {server.address[0]}:{server.address[1]}", file=sys.stderr, flush=True)  # noqa: T201
            counts = send(folder.endpoint(kind), messages, server, interrupt)
    finally:
        server.close()
    typer.echo(json.dumps(counts))
    return OK
