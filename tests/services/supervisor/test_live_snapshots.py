"""The command that writes the current live model."""

from __future__ import annotations

import threading
import weakref
from types import SimpleNamespace

import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.models import SnapshotSlots
from operators.reconstruct import ModelRequest
from services.errors import BadMessage, CommandRefused
from services.supervisor import engine
from services.supervisor.engine import LiveSnapshots
from tests.services.supervisor.test_model_show import uniform


class Reconstruct:
    """Answers model requests in another thread, as the operator does."""

    def __init__(self, answer) -> None:
        self.answer = answer

    def request_model(self) -> ModelRequest:
        request = ModelRequest()
        threading.Thread(target=self.answer, args=(request,)).start()
        return request


def take(answer, folder):
    snapshots = LiveSnapshots()
    with snapshots.of(SimpleNamespace(reconstruct=Reconstruct(answer))):
        return snapshots.take({"folder": str(folder)})


def test_take_writes_model_and_reports_its_figures(tmp_path):
    model = uniform((0.9, 0.1, 0.1), version=8)
    said = take(lambda request: request.answer(model, SimpleNamespace(seq=41), 1_500_000), tmp_path / "model")
    assert (said["seq"], said["model_version"], said["gaussians"]) == (41, 8, 144)
    assert said["pause_ms"] == 1.5 and said["time_window_s"] == [1.0, 3.0] and said["written_ms"] > 0
    assert load_bundle(tmp_path / "model").sha256() == model.sha256()


def test_take_writes_same_bundle_for_snapshot_and_model_on_device(device, tmp_path):
    model = uniform((0.1, 0.9, 0.1))
    slots = SnapshotSlots(device)
    snapshot = slots.publish(
        model.gaussians.to(device), None, version=1, camera=model.camera, time_window_s=model.time_window_s
    )
    for number, given in enumerate((snapshot, model.to(device))):
        folder = tmp_path / str(number)
        take(lambda request, given=given: request.answer(given, SimpleNamespace(seq=1), 0), folder)
        assert load_bundle(folder).sha256() == model.sha256()


def test_take_releases_snapshot_before_writing(tmp_path, monkeypatch):
    model = uniform((0.1, 0.9, 0.1))
    snapshot = SnapshotSlots("cpu").publish(
        model.gaussians, None, version=1, camera=model.camera, time_window_s=model.time_window_s
    )
    held = weakref.ref(snapshot)
    waiting = [snapshot]
    del snapshot
    kept = []
    monkeypatch.setattr(engine, "save_bundle", lambda *_: kept.append(held() is not None))
    take(lambda request: request.answer(waiting.pop(), SimpleNamespace(seq=1), 0), tmp_path)
    assert kept == [False]


def test_take_raises_with_reason_without_live_model_or_folder(tmp_path, monkeypatch):
    with pytest.raises(CommandRefused, match="no live reconstruction runs"):
        LiveSnapshots().take({"folder": str(tmp_path)})
    with pytest.raises(CommandRefused, match="the reconstruction has ended"):
        take(lambda request: request.refuse("the reconstruction has ended"), tmp_path)
    monkeypatch.setattr(engine, "WAIT_S", 0.05)
    with pytest.raises(CommandRefused, match="no frame has come"):
        take(lambda request: None, tmp_path)
    with pytest.raises(BadMessage, match="folder"):
        LiveSnapshots().take({})
