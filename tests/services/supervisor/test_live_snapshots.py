"""The command that writes the live model as it stands."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.scene.snapshots import SnapshotSlots
from operators.model_request import ModelRequest
from services.bus.errors import BadMessage, CommandRefused
from services.supervisor import live_snapshots
from services.supervisor.live_snapshots import LiveSnapshots, on_host
from tests.services.supervisor.test_model_show import uniform


class Reconstruct:
    """Answers in another thread, as the operator does."""

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


def test_the_model_is_written_as_it_was_given(tmp_path):
    model = uniform((0.9, 0.1, 0.1), version=8)
    said = take(lambda request: request.answer(model, SimpleNamespace(seq=41), 1_500_000), tmp_path / "model")
    assert (said["seq"], said["model_version"], said["gaussians"]) == (41, 8, 144)
    assert said["pause_ms"] == 1.5 and said["time_window_s"] == [1.0, 3.0] and said["written_ms"] > 0
    assert load_bundle(tmp_path / "model").sha256() == model.sha256()


def test_a_snapshot_on_any_device_is_written_as_its_model(device):
    model = uniform((0.1, 0.9, 0.1))
    slots = SnapshotSlots(device)
    snapshot = slots.publish(
        model.gaussians.to(device), None, version=1, camera=model.camera, time_window_s=model.time_window_s
    )
    host = on_host(snapshot)
    assert host.device.type == "cpu" and host.sha256() == model.sha256()
    assert on_host(model.to(device)).sha256() == model.sha256()


def test_what_cannot_be_written_is_refused_with_its_reason(tmp_path, monkeypatch):
    with pytest.raises(CommandRefused, match="no live reconstruction runs"):
        LiveSnapshots().take({"folder": str(tmp_path)})
    with pytest.raises(CommandRefused, match="the reconstruction has ended"):
        take(lambda request: request.refuse("the reconstruction has ended"), tmp_path)
    monkeypatch.setattr(live_snapshots, "WAIT_S", 0.05)
    with pytest.raises(CommandRefused, match="no frame has come"):
        take(lambda request: None, tmp_path)
    with pytest.raises(BadMessage, match="folder"):
        LiveSnapshots().take({})
