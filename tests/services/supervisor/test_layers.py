"""Layers of an engine are drawn only while they are watched."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
import zmq

from gsplat_core.errors import InvalidSetting
from services.bus.messages import picture_from, subscribe
from services.errors import BadMessage
from services.supervisor import screen as layers_module
from services.supervisor.screen import Layers

SOON_S = 300.0
NOW = {"seq": 5, "state": "live", "show": "live", "new": True}


class Drawing:
    """Layer drawing that records the requested layers."""

    def __init__(self, device: str) -> None:
        self.drawn: list[str] = []

    def draw(self, layer, scene):
        if scene == "broken":
            raise ValueError("a broken scene")
        self.drawn.append(layer)
        return np.zeros((60, 80, 3), np.uint8), {"azimuth": self.orbit.azimuth_deg}


@pytest.fixture
def opened(runtime, monkeypatch):
    monkeypatch.setitem(layers_module.PERIOD_S, "cpu", 0.001)
    folder = runtime.stream("a")
    layers = Layers(folder, "cpu", Drawing)
    layers.open()
    with zmq.Context() as context:

        def reader(layer):
            return subscribe(context.socket(zmq.SUB), folder.endpoint(layer))

        yield SimpleNamespace(layers=layers, reader=reader, folder=folder)
    layers.close()


def scene(**header):
    return lambda: SimpleNamespace(header={**NOW, "arrived_ns": time.monotonic_ns(), **header})


def next_picture(layers, reader, offered=None):
    until_s = time.monotonic() + SOON_S
    while not reader.poll(20):
        assert time.monotonic() < until_s, "no picture came"
        layers.offer(offered or scene())
    return picture_from(reader.recv_multipart(copy=False))


def test_layers_without_viewers_do_not_request_scene(opened):
    def asked():
        raise AssertionError("nobody watches")

    for _ in range(20):
        opened.layers.offer(asked)
        time.sleep(0.01)
    figures = opened.layers.figures()["layers"]
    assert all(figures[layer] == {"watched": False, "drawn": 0} for layer in ("depth", "confidence", "orbit"))
    assert "failed" not in figures


def test_only_watched_layer_is_drawn_until_viewer_leaves(opened):
    with opened.reader("depth") as reader:
        header = next_picture(opened.layers, reader).header
        assert (header["layer"], header["seq"], header["state"]) == ("depth", 5, "live")
        assert header["age_ms"] >= 0
    until_s = time.monotonic() + SOON_S
    while opened.layers.figures()["layers"]["depth"]["watched"]:
        assert time.monotonic() < until_s
        opened.layers.offer(scene())
        time.sleep(0.01)
    figures = opened.layers.figures()["layers"]
    assert figures["depth"]["drawn"] >= 1 and figures["orbit"]["drawn"] == figures["confidence"]["drawn"] == 0


def test_all_watched_layers_get_pictures(opened):
    with opened.reader("depth") as depth, opened.reader("confidence") as confidence, opened.reader("orbit") as orbit:
        for _ in range(3):
            for reader in (depth, confidence, orbit):
                next_picture(opened.layers, reader)


def test_layer_state_is_source_lost_or_frozen_as_scene(opened):
    with opened.reader("depth") as reader:
        lost = scene(state="source lost")
        while next_picture(opened.layers, reader, lost).header["state"] != "source lost":
            pass
        old = scene(arrived_ns=time.monotonic_ns() - 5_000_000_000)
        while next_picture(opened.layers, reader, old).header["state"] != "frozen":
            pass


def test_layers_report_drawing_error_and_draw_next_scene(opened):
    with opened.reader("depth") as reader:
        until_s = time.monotonic() + SOON_S
        while "failed" not in opened.layers.figures()["layers"]:
            assert time.monotonic() < until_s
            opened.layers.offer(lambda: "broken")
            time.sleep(0.01)
        assert "a broken scene" in opened.layers.figures()["layers"]["failed"]
        next_picture(opened.layers, reader)


def test_camera_command_applies_to_next_orbit_picture(opened):
    assert opened.layers.camera({"azimuth_deg": 12}) == {"azimuth_deg": 12.0, "elevation_deg": 0.0, "zoom": 1.0}
    with opened.reader("orbit") as reader:
        while next_picture(opened.layers, reader).header["azimuth"] != 12.0:
            pass


@pytest.mark.parametrize("wrong", [{"zoom": "2"}, {"azimuth_deg": True}, {"elevation_deg": None}])
def test_camera_command_rejects_non_numbers(opened, wrong):
    with pytest.raises(BadMessage, match="give a number"):
        opened.layers.camera(wrong)


def test_camera_command_rejects_angles_out_of_range(opened):
    with pytest.raises(InvalidSetting, match="azimuth"):
        opened.layers.camera({"azimuth_deg": 90})


def test_clean_removes_sockets_of_closed_layers(runtime):
    layers = Layers(runtime.stream("b"), "cpu", Drawing)
    layers.open()
    until_s = time.monotonic() + SOON_S
    while not (runtime.path / "b" / "orbit").exists():
        assert time.monotonic() < until_s
        time.sleep(0.01)
    layers.close()
    runtime.stream("b").clean("engine")
    assert not (runtime.path / "b" / "orbit").exists()
