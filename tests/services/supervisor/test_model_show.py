"""Finished models on an engine's screen: switching between pictures, fallback on failure."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from operators.sources.source import SourceState
from services.errors import BadMessage, CommandRefused
from services.supervisor import engine
from services.supervisor.engine import LATE_IN_A_ROW, FinishedModel, ModelShow, NotFinite, Showing
from services.supervisor.screen import Screen
from services.supervisor.worker import EngineSpec

COLOURS = {1: (0.9, 0.1, 0.1), 2: (0.1, 0.9, 0.1), 3: (0.1, 0.1, 0.9)}
SOON_S = 300.0


class Published:
    """Publisher that records headers and images."""

    def __init__(self) -> None:
        self.headers: list[dict] = []
        self.images: list[np.ndarray] = []

    def publish(self, header, image) -> None:
        self.headers.append(dict(header))
        self.images.append(image)


class Frames:
    """Source with a frame every 10 ms."""

    def __init__(self, folder, stop) -> None:
        self.state, self.seq = SourceState.LIVE, 0

    def open(self) -> None: ...
    def close(self) -> None: ...

    def read(self, timeout_s):
        time.sleep(0.01)
        self.seq += 1
        return Frame(self.seq, self.seq * 10_000_000, np.zeros((4, 4, 3), np.uint8), arrived_ns=time.monotonic_ns())


def uniform(colour, version: int = 1) -> Model:
    """Return a model of a wall of one colour in front of the camera."""
    x, y = torch.meshgrid(torch.linspace(-2, 2, 12), torch.linspace(-2, 2, 12), indexing="xy")
    count = x.numel()
    means = torch.stack([x.reshape(-1), y.reshape(-1), torch.full((count,), 4.0)], 1)
    sh = ((torch.tensor(colour) - 0.5) / 0.28209479177387814).expand(count, 1, 3).clone()
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    gaussians = Gaussians(means, quats, torch.full((count, 3), -1.0), torch.full((count,), 6.0), sh)
    return Model(version, gaussians, None, Camera.from_focal(20.0, 32, 24), (1.0, 3.0))


@pytest.fixture
def bundles(tmp_path):
    for version, colour in COLOURS.items():
        save_bundle(uniform(colour), tmp_path / str(version))
    return tmp_path


@pytest.fixture
def show(runtime, monkeypatch):
    monkeypatch.setattr(engine, "CapturedSource", Frames)
    stop = threading.Event()
    worker = SimpleNamespace(folder=runtime.stream("a"), stop_requested=stop.is_set)
    published = Published()
    screen = Screen(published)
    models = ModelShow(worker, EngineSpec(), screen)
    yield SimpleNamespace(models=models, screen=screen, out=published, worker=worker)
    stop.set()
    models.close()


def wait_until(what) -> None:
    until_s = time.monotonic() + SOON_S
    while not what():
        assert time.monotonic() < until_s, "condition not met in time"
        time.sleep(0.005)


def versions(show) -> list[int]:
    return [header["model_version"] for header in show.out.headers]


def command(bundles, version: int, **more) -> dict:
    return {"folder": str(bundles / str(version)), "version": version, "name": "wall", **more}


def test_pictures_match_model_version_of_their_header(show, bundles):
    for version in (1, 2, 3, 1, 2):
        show.models.show(command(bundles, version))
        wait_until(lambda version=version: versions(show)[-1:] == [version])
    assert {header["model"] for header in show.out.headers} == {"wall"}
    for header, image in zip(show.out.headers, show.out.images, strict=True):
        colour = image.reshape(-1, 3).mean(0)
        assert colour.argmax() == header["model_version"] - 1
        assert (image.reshape(-1, 3).argmax(1) == colour.argmax()).all()


def test_show_previous_swaps_current_and_previous_model(show, bundles):
    show.models.show(command(bundles, 1))
    with pytest.raises(CommandRefused, match="no model was shown before"):
        show.models.show_previous({})
    show.models.show(command(bundles, 2))
    assert show.models.show_previous({}) == {"version": 1}
    wait_until(lambda: versions(show)[-1:] == [1])
    assert show.models.show_previous({}) == {"version": 2}


def fails_from_now_on(monkeypatch, version: int) -> None:
    draw = FinishedModel.picture

    def picture(self, stream_s):
        if self.version == version:
            raise NotFinite("version 2 gives values that are not finite")
        return draw(self, stream_s)

    monkeypatch.setattr(FinishedModel, "picture", picture)


def test_model_with_non_finite_picture_is_replaced_by_previous(show, bundles, monkeypatch):
    show.models.show(command(bundles, 1))
    show.models.show(command(bundles, 2))
    wait_until(lambda: versions(show)[-1:] == [2])
    fails_from_now_on(monkeypatch, 2)
    wait_until(lambda: versions(show)[-1] == 1)
    figures = show.models.figures()
    assert figures["model"] == {"name": "wall", "version": 1}
    assert [(each["version"], "not finite" in each["reason"]) for each in figures["gave_way"]] == [(2, True)]
    assert show.screen.wanted == "model"


def test_failed_model_without_previous_is_replaced_by_live(show, bundles, monkeypatch):
    show.models.show(command(bundles, 2))
    wait_until(lambda: versions(show)[-1:] == [2])
    fails_from_now_on(monkeypatch, 2)
    wait_until(lambda: show.screen.wanted == "live")
    wait_until(lambda: show.models.figures()["model"] is None)
    assert not (show.worker.folder.path / "engine.show").exists()


def test_model_over_most_ms_is_replaced_by_previous(show, bundles):
    show.models.show(command(bundles, 1))
    wait_until(lambda: versions(show)[-1:] == [1])
    show.models.show(command(bundles, 2, most_ms=1e-6))
    wait_until(lambda: show.models.figures()["gave_way"])
    wait_until(lambda: versions(show)[-1] == 1)
    assert versions(show).count(2) <= LATE_IN_A_ROW
    assert "in a row" in show.models.figures()["gave_way"][0]["reason"]


def test_finished_model_picture_raises_for_non_finite_values(bundles):
    model = FinishedModel(bundles / "1", "wall", 1, device="cpu", renderer="alpha")
    model._model.gaussians.means[3, 1] = float("nan")
    with pytest.raises(NotFinite, match="wall 1 has values that are not finite"):
        model.picture(0.0)


def test_show_live_keeps_model_until_first_live_picture(show, bundles):
    show.models.show(command(bundles, 1))
    wait_until(lambda: versions(show)[-1:] == [1])
    show.models.show_live({})
    count = len(show.out.headers)
    wait_until(lambda: len(show.out.headers) > count + 3)  # nothing live is there yet: the model goes on
    live = {"new": True, "state": "live", "age_ms": 1.0, "model_version": 99, "psnr_db": None}
    assert show.screen.publish("live", live, np.zeros((2, 2, 3), np.uint8))
    wait_until(lambda: show.models.figures()["model"] is None)
    shows = [header["show"] for header in show.out.headers]
    assert shows[shows.index("live") :] == ["live"]
    show.models.show(command(bundles, 2))
    wait_until(lambda: versions(show)[-1] == 2)
    assert not show.screen.publish("live", live, np.zeros((2, 2, 3), np.uint8))


def test_begin_shows_model_of_previous_engine(show, bundles):
    show.models.show(command(bundles, 2))
    other = Screen(Published())
    models = ModelShow(show.worker, EngineSpec(), other)
    models.begin()
    assert other.wanted == "model" and models.figures()["model"] == {"name": "wall", "version": 2}
    (bundles / "2" / "model.safetensors").unlink()
    third = ModelShow(show.worker, EngineSpec(), Screen(Published()))
    third.begin()
    assert third.figures()["model"] is None


@pytest.mark.parametrize(
    "wrong",
    [
        {"version": "1"},
        {"version": 0},
        {"version": True},
        {"folder": 3},
        {"name": 4},
        {"most_ms": -1},
        {"most_ms": "x"},
    ],
)
def test_show_command_rejects_wrong_arguments(show, bundles, wrong):
    with pytest.raises(BadMessage):
        show.models.show({**command(bundles, 1), **wrong})
    assert show.screen.wanted == "live"


def test_finished_model_time_wraps_around_time_window(bundles):
    model = FinishedModel(bundles / "1", "wall", 1, device="cpu", renderer="alpha")
    assert [model.at(time_s) for time_s in (0.0, 0.5, 2.0, 3.5, -1.0)] == [1.0, 1.5, 1.0, 2.5, 1.0]


@pytest.mark.parametrize(
    ("took_ms", "given_up"),
    [
        ([11, 11, 11, 11, 11], 1), ([11, 11, 11, 11, 10, 11, 11, 11, 11], 0), ([10.0] * 20, 0), ([10.01] * 4, 0), ([50, 50, 50, 50, 50], 1),
    ],
)  # fmt: skip
def test_model_is_replaced_after_five_consecutive_late_pictures(monkeypatch, took_ms, given_up):
    """A single late picture may be due to other load."""
    show, reasons = object.__new__(ModelShow), []
    show._late = 0
    showing = Showing(SimpleNamespace(name="liver", version=3), {}, 10.0)
    monkeypatch.setattr(show, "_give_way", lambda which, why: reasons.append((which, why)))
    for each in took_ms:
        show._check_time(showing, each)
    assert len(reasons) == given_up and all(which is showing and "liver 3 took" in why for which, why in reasons)
    unlimited = Showing(SimpleNamespace(name="liver", version=3), {}, None)
    for _ in range(20):
        show._check_time(unlimited, 1e6)
    assert len(reasons) == given_up
