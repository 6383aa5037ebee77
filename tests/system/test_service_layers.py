# ruff: noqa: F811 - fixtures of another module
"""Layers, virtual camera, snapshots and exports of a running service, through its API and console."""

from __future__ import annotations

import json
import struct
import time

import cv2
import numpy as np
import pytest

from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.ply import load_ply
from services.client import Refused
from services.registry.bundle_file import unpack
from tests.gsplat_core.io.exports.glb_reader import read_glb
from tests.system.test_service import brightness, page, served, wait_until, walls  # noqa: F401 - fixtures

pytestmark = pytest.mark.slow


def layers_of(client):
    return client.stream("theatre").processes["engine"]["figures"]["layers"]


@pytest.mark.parametrize("kind", ["depth", "confidence", "orbit"])
def test_layer_is_drawn_only_while_watched(served, kind):
    client, _, log = served
    assert not layers_of(client)[kind]["watched"]
    shown = client.pictures("theatre", kind)
    pictures = [next(shown) for _ in range(3)]
    shown.close()
    header = pictures[-1].header
    assert (header["layer"], header["picture"], header["width_px"]) == (kind, kind, 160)
    assert header["state"] in ("live", "stale") and header["age_ms"] >= 0
    assert ("legend" in header) == (kind != "orbit") and ("virtual" in header) == (kind == "orbit")
    image = cv2.imdecode(np.frombuffer(pictures[-1].jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert image.shape == (128, 160, 3) and image.std() > 5
    wait_until(lambda: not layers_of(client)[kind]["watched"], log)

    def rests():
        before = layers_of(client)[kind]["drawn"]
        time.sleep(0.6)
        return layers_of(client)[kind]["drawn"] == before > 0

    wait_until(rests, log)  # one may be drawn while the figures already report no viewer


def test_turn_camera_changes_virtual_view(served):
    client, _, _ = served
    client.turn_camera("theatre", azimuth_deg=30)
    shown = client.pictures("theatre", "orbit")
    seen = next(picture.header for picture in shown if picture.header["virtual"]["azimuth_deg"] == 30)
    shown.close()
    assert seen["virtual"] == {"azimuth_deg": 30, "elevation_deg": 0, "zoom": 1}
    with pytest.raises(Refused, match="75"):
        client.turn_camera("theatre", elevation_deg=80)


def test_snapshot_is_taken_exported_and_deleted(served, tmp_path):
    client, _, _ = served
    taken = client.take_snapshot("theatre", idempotency_key="one")
    assert client.take_snapshot("theatre", idempotency_key="one") == taken
    assert taken.gaussians > 50 and taken.pause_ms >= 0
    assert [each.id for each in client.snapshots("theatre")] == [taken.id]
    client.export_snapshot("theatre", taken.id, "isplat", tmp_path / "x.isplat")
    (tmp_path / "model").mkdir()
    with (tmp_path / "x.isplat").open("rb") as file:
        unpack(file, (tmp_path / "x.isplat").stat().st_size, tmp_path / "model")
    model = load_bundle(tmp_path / "model")
    assert model.gaussians.count == taken.gaussians and model.version == taken.model_version
    client.export_snapshot("theatre", taken.id, "ply", tmp_path / "x.ply")
    last = load_ply(tmp_path / "x.ply")
    np.testing.assert_allclose(last.means, model.at(model.time_window_s[1]).means, atol=1e-5)
    client.delete_snapshot("theatre", taken.id)
    with pytest.raises(Refused, match="no such snapshot"):
        client.export_snapshot("theatre", taken.id, "ply", tmp_path / "y.ply")
    assert not (tmp_path / "y.ply").exists()


def test_snapshot_as_model_version_is_activated_and_exported(served, tmp_path):
    client, _, _ = served
    taken = client.take_snapshot("theatre", "liver")
    number = taken.version.version
    assert client.checked("liver", number).state == "ready"
    client.activate("liver", number, expected_current=None)
    size = client.export_version("liver", number, "glb", tmp_path / "liver.glb")
    data = (tmp_path / "liver.glb").read_bytes()
    _, values = read_glb(data)
    assert size == len(data) and len(values["POSITION"]) == taken.gaussians
    start_s, end_s = taken.time_window_s
    client.export_version("liver", number, "splat", tmp_path / "liver.splat", time_s=(start_s + end_s) / 2)
    assert (tmp_path / "liver.splat").stat().st_size == 32 * taken.gaussians
    with pytest.raises(Refused, match="window"):
        client.export_version("liver", number, "ply", tmp_path / "z.ply", time_s=end_s + 100)


def test_model_stream_has_layers_but_no_snapshots(served, walls):
    client, _, log = served
    made = client.upload("wall", walls / "red.isplat")
    assert client.checked("wall", made.version).state == "ready"
    client.activate("wall", made.version, expected_current=None)
    client.create_stream("playback", client.stream("theatre").source, show="model wall", device="cpu")
    wait_until(lambda: client.stream("playback").processes.get("engine", {}).get("figures", {}).get("model"), log)
    shown = client.pictures("playback", "depth")
    header = next(picture.header for picture in shown if picture.header["show"] == "model")
    shown.close()
    assert header["legend"]["unit"] == "relative" and header["model"] == "wall"
    with pytest.raises(Refused) as refused:
        client.stop_stream("playback")
        client.take_snapshot("playback")
    assert refused.value.status == 409
    client.delete_stream("playback")


def test_console_shows_layers_and_turns_virtual_camera(page):
    for layer in ("depth", "confidence", "orbit"):
        page.click(f"#choose-{layer}")
        page.wait_for_selector(f".layer.{layer} .badge:not([data-state='no picture'])")
    assert page.locator("#pictures canvas:not(.legend)").count() == 5
    page.locator(".layer.depth .legend[data-said]").wait_for()
    assert brightness(page, "orbit") > 10
    page.click("#orbit-reset")
    page.locator(".orbit-controls output", has_text="0° across, 0° up").wait_for()
    page.focus("#orbit")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.locator(".orbit-controls output", has_text="+20° across").wait_for()
    box = page.locator("#orbit").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2 + 60, steps=4)
    page.mouse.up()
    page.locator(".orbit-controls output", has_text="+20° across, +").wait_for()
    page.click("#orbit-reset")
    page.locator(".orbit-controls output", has_text="0° across, 0° up").wait_for()
    for layer in ("depth", "confidence", "orbit"):
        page.click(f"#choose-{layer}")
    assert page.locator("#pictures canvas").count() == 2


def test_console_takes_and_saves_snapshot(page, tmp_path):
    page.click("#take-snapshot")
    page.locator(".said", has_text="Gaussians").wait_for()
    page.locator(".files select").first.select_option("glb")
    with page.expect_download() as started:
        page.locator(".files button").first.click()
    started.value.save_as(tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    assert started.value.suggested_filename.endswith(".glb") and struct.unpack_from("<4sI", data) == (b"glTF", 2)
    assert json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])["asset"]["generator"] == "IntraSplat"
