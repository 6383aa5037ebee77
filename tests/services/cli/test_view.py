"""`intrasplat view` and `intrasplat igtl`: refused options, model loading and serving."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from typer.main import get_command

from gsplat_core.errors import BundleError, InvalidSetting
from gsplat_core.io.bundle import save_bundle
from gsplat_core.rendering.renderer import RendererOptions
from services.cli import models, serve
from services.cli.app import app
from services.cli.app import view as run_view
from services.cli.models import bundle_in, view_command
from services.cli.serve import igtl_command
from services.cli.terminal import OK
from tests.gsplat_core.io.exports.test_exports import random_model

HERE = {"plaintext": False, "options": RendererOptions(), "device": "cpu"}


class Server:
    """Stand-in for a server of a model."""

    made: ClassVar[list[tuple[Any, ...]]] = []
    address = "127.0.0.1", 18080

    def __init__(self, *arguments: Any) -> None:
        self.made.append(arguments)
        self.ran = self.closed = False

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True

    def run(self, interrupt: Any) -> None:
        self.ran = not interrupt()

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def model(tmp_path: Path) -> Path:
    save_bundle(random_model(field=False), tmp_path / "model")
    return tmp_path / "model"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    monkeypatch.setattr(Server, "made", [])
    for module, name in ((models, "ModelView"), (models, "PictureView"), (serve, "MessageServer")):
        monkeypatch.setattr(module, name, type(name, (Server,), {}))
    monkeypatch.setattr(models, "Pictures", lambda *given: given)
    return Server.made


def test_view_command_serves_model_with_and_without_renderer(
    model: Path, made: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert view_command(model, "127.0.0.1", 8, renderer=None, **HERE) == OK
    ((shown, host, port),) = made
    assert (host, port) == ("127.0.0.1", 8) and shown.gaussians.count == random_model(field=False).gaussians.count
    assert "http://127.0.0.1:18080/" in capsys.readouterr().err
    assert view_command(model, "localhost", 9, renderer="alpha", **HERE) == OK
    (_, renderer, _, device), window_s, *address = made[1]
    assert (renderer, device, address) == ("alpha", "cpu", ["localhost", 9]) and window_s == shown.time_window_s


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"device": "cuda"}, "give --renderer"),
        ({"options": replace(RendererOptions(), supersampling=2)}, "give --renderer"),
        ({"renderer": "nothing"}, "nothing"),
        ({"host": "10.0.0.1"}, "beyond this machine"),
        ({"host": "0.0.0.0", "renderer": "alpha"}, "beyond this machine"),
    ],
)
def test_view_command_checks_options_before_reading_model(
    made: list[Any], tmp_path: Path, changed: dict[str, Any], reason: str
) -> None:
    given = {"host": "127.0.0.1", "port": 8, "renderer": None, **HERE, **changed}
    with pytest.raises(InvalidSetting, match=reason):
        view_command(tmp_path / "none", **given)
    assert made == []


def test_igtl_command_sends_pictures_and_prints_counts(
    made: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    sent = []

    def send(endpoint: Any, messages: Any, server: Any, interrupt: Any) -> dict[str, int]:
        assert not server.closed
        sent.append((endpoint, messages, server))
        return {"pictures": 3}

    monkeypatch.setattr(serve, "folder_of", lambda runtime, stream: SimpleNamespace(endpoint=lambda kind: f"{runtime.name}/{stream}/{kind}"))  # fmt: skip
    monkeypatch.setattr(serve, "StreamMessages", lambda name, spacing_mm: (name, spacing_mm))
    monkeypatch.setattr(serve, "send", send)
    given = {"config": None, "host": "127.0.0.1", "port": 8, "spacing_mm": 0.5, "plaintext": False}
    long = "a-stream-with-a-long-name"
    assert igtl_command(long, runtime=tmp_path, kind="shown", name=None, **given) == OK
    ((endpoint, messages, server),) = sent
    assert endpoint == f"{tmp_path.name}/{long}/shown" and messages == (long[:13], 0.5) and server.closed
    out, err = capsys.readouterr()
    assert json.loads(out) == {"pictures": 3} and "127.0.0.1:18080" in err
    assert igtl_command(long, runtime=tmp_path, kind="shown", name="own", **given) == OK
    assert sent[1][1] == ("own", 0.5)
    with pytest.raises(InvalidSetting, match="there is no picture 'other'"):
        igtl_command(long, runtime=tmp_path, kind="other", name=None, **given)
    with pytest.raises(InvalidSetting, match="beyond this machine"):
        igtl_command(long, runtime=tmp_path, kind="shown", name=None, **{**given, "host": "::"})
    assert len(made) == 2


def test_igtl_command_closes_server_if_sending_fails(
    made: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    servers = []

    def send(endpoint: Any, messages: Any, server: Any, interrupt: Any) -> None:
        servers.append(server)
        raise OSError("broken")

    monkeypatch.setattr(serve, "folder_of", lambda runtime, stream: SimpleNamespace(endpoint=str))
    monkeypatch.setattr(serve, "send", send)
    with pytest.raises(OSError, match="broken"):
        igtl_command("theatre", None, tmp_path, kind="shown", host="127.0.0.1", port=8, name=None, spacing_mm=1.0, plaintext=False)  # fmt: skip
    assert servers[0].closed


def test_bundle_in_yields_folder_or_temporarily_unpacked_file(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bundle_in(model) as folder:
        assert folder == model
    folder_with_suffix = model.rename(tmp_path / "model.isplat")
    with bundle_in(folder_with_suffix) as folder:
        assert folder == folder_with_suffix
    packed = tmp_path / "packed.isplat"
    packed.write_bytes(b"packed")
    monkeypatch.setattr(models, "unpack", lambda file, size, into: (into / "content").write_bytes(file.read(size)))
    with bundle_in(packed) as folder:
        assert (folder / "content").read_bytes() == b"packed"
    assert not folder.exists()

    def unpack(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(models, "unpack", unpack)
    with pytest.raises(BundleError, match="cannot be read: No space left"), bundle_in(packed):
        pass


def test_view_help_states_default_samples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`view` has fewer samples by default because they accumulate while the camera is still."""
    made = []
    monkeypatch.setattr(models, "view_command", lambda *arguments, options, **others: made.append(options) or OK)
    run_view(tmp_path, host="127.0.0.1", port=8, renderer="stochastic", device="cpu")
    (stated,) = (each for each in get_command(app).commands["view"].params if each.name == "samples")  # type: ignore[attr-defined]
    assert stated.show_default == str(made[0].samples)
    assert made[0].samples < RendererOptions().samples
