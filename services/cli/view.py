"""Implementation of `intrasplat view` and `intrasplat igtl`, and the check of listen addresses for servers without keys or encryption."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from gsplat_core.errors import BundleError, InvalidSetting
from gsplat_core.io.model_files import open_model_file
from gsplat_core.io.model_sources import load_model
from gsplat_core.models import Model
from gsplat_core.rendering.renderer import RendererOptions, check_renderer
from operators.applications.session import check_device
from services.cli.terminal import OK, InterruptRequest
from services.display import KINDS
from services.model_view import ModelView, Pictures, PictureView
from services.openigtlink import MessageServer, StreamMessages, folder_of, send
from services.registry.bundle_file import SUFFIX, unpack
from services.settings import is_loopback, load_settings


def check_host(host: str, plaintext: bool, why: str) -> None:
    """Check that an address is a loopback address, unless `plaintext` is set.

    Args:
        host: address to listen on.
        plaintext: allow other addresses.
        why: explanation for the error message.

    Raises:
        InvalidSetting: if the address is reachable from other machines.
    """
    if not is_loopback(host) and not plaintext:
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
