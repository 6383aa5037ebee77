"""`intrasplat serve` as a process: console in a browser, API, and killed engines."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.io.bundle import save_bundle
from services.client import Client, Refused
from services.registry.bundle_file import pack
from tests.services.supervisor.test_model_show import uniform
from tests.system.browsers import chromium_by_playwright

pytestmark = pytest.mark.slow

SOURCE = "synthetic:?width=160&height=128&frames=12&fps=15"
WITHIN_S = 300.0


@pytest.fixture(scope="module")
def served():
    """A service with one small stream, and a client with its administrator's key."""
    with tempfile.TemporaryDirectory(prefix="isp-") as folder:
        data, log = Path(folder) / "data", Path(folder) / "log"
        config = Path(folder) / "service.yaml"
        config.write_text(
            f"server: {{port: 0}}\npaths: {{data: {data}, runtime: {folder}/r}}\nlog: {{format: text}}\n"
            f'streams: {{theatre: {{source: "{SOURCE}", device: cpu, options: {{engine_scale: 1}}}}}}\n'
        )
        with log.open("w") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "services.cli", "serve", "--config", config], stdout=output, stderr=output
            )
        try:
            url = wait_until(lambda: re.search(r"IntraSplat is on (http://\S+?)(?:/\S*)?\n", log.read_text()), log)[1]
            with Client(url, (data / "admin.key").read_text()) as client:
                wait_until(lambda: client.stream("theatre").state == "live", log)
                yield client, url, log
            process.send_signal(signal.SIGTERM)
            assert process.wait(300) == 0, log.read_text()
            assert not [each for each in Path(folder, "r").rglob("*.json")], "a process or its socket was left"
        finally:
            process.kill()
            process.wait()


def wait_until(found, log, within_s=WITHIN_S):
    """Poll `found` until its result is true and return the result."""
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        result = found()
        if result:
            return result
        time.sleep(0.05)
    raise AssertionError(f"condition not met within {within_s} s:\n{log.read_text()[-4000:]}")


def test_service_reports_its_parts_and_stream(served):
    client, _, _ = served
    assert {"streams", "models", "display"} <= set(client.about()["parts"])
    stream = client.stream("theatre")
    assert (stream.source, stream.show, stream.device) == (SOURCE, "live", "cpu")
    assert stream.processes["engine"]["state"] == "running" and stream.processes["capture"]["state"] == "live"


@pytest.mark.parametrize("kind", ["raw", "shown"])
def test_viewer_receives_pictures_with_age(served, kind):
    client, _, _ = served
    shown = client.pictures("theatre", kind)
    headers = [next(shown).header for _ in range(5)]
    shown.close()
    assert [header["seq"] for header in headers] == sorted(header["seq"] for header in headers)
    assert all(header["state"] in ("live", "stale") and header["age_ms"] >= 0 for header in headers)
    assert all((header["width_px"], header["height_px"]) == (160, 128) for header in headers)


def test_raw_pictures_continue_while_killed_engine_restarts(served):
    client, _, log = served
    before = client.stream("theatre").processes["engine"]
    raw = client.pictures("theatre", "raw")
    next(raw)
    os.kill(before["pid"], signal.SIGKILL)
    numbers = set()

    def back():
        numbers.add(next(raw).header["seq"])
        found = client.stream("theatre")
        return found.state == "live" and found.processes["engine"]["pid"] != before["pid"] and found

    after = wait_until(back, log).processes["engine"]
    raw.close()
    assert len(numbers) >= 5, "an engine takes seconds to start, and the camera gives fifteen pictures a second"
    assert after["restarts"] == before["restarts"] + 1


@pytest.fixture(scope="module")
def walls(tmp_path_factory):
    """Packed models of a red and of a green wall."""
    folder = tmp_path_factory.mktemp("walls")
    for name, colour in (("red", (0.9, 0.1, 0.1)), ("green", (0.1, 0.9, 0.1))):
        save_bundle(uniform(colour), folder / name)
        pack(folder / name, folder / f"{name}.isplat")
    return folder


def colour_shown(client, stream):
    """Return the dominant colour in the middle of the newest picture, and the model version in its header."""
    shown = client.pictures(stream)
    picture = next(shown)
    shown.close()
    image = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    middle = image[image.shape[0] // 2, image.shape[1] // 2]
    return ("red", "green", "blue")[int(middle.argmax())], picture.header["model_version"]


def test_model_stream_follows_activation_and_rollback(served, walls):
    client, _, log = served
    versions = []
    for name in ("red", "green"):
        made = client.upload("wall", walls / f"{name}.isplat")
        assert client.checked("wall", made.version).state == "ready"
        versions.append(made.version)
    with pytest.raises(Refused, match="active"):
        client.activate("wall", versions[0], expected_current=7)
    client.activate("wall", versions[0], expected_current=None)
    client.create_stream("playback", SOURCE, show="model wall", device="cpu")
    wait_until(lambda: client.stream("playback").state == "live", log)
    wait_until(lambda: colour_shown(client, "playback") == ("red", versions[0]), log)
    client.activate("wall", versions[1], expected_current=versions[0])
    wait_until(lambda: colour_shown(client, "playback") == ("green", versions[1]), log)
    client.rollback("wall")
    wait_until(lambda: colour_shown(client, "playback") == ("red", versions[0]), log)
    with pytest.raises(Refused, match="active"):
        client.delete_version("wall", versions[0])
    client.delete_stream("playback")
    with pytest.raises(Refused, match="no stream"):
        client.stream("playback")


def test_upload_of_invalid_model_returns_422(served, tmp_path):
    client, _, _ = served
    (tmp_path / "x.isplat").write_bytes(b"\x80\x04" + bytes(3000))
    with pytest.raises(Refused) as refused:
        client.upload("wall", tmp_path / "x.isplat")
    assert refused.value.status == 422


def test_unknown_stream_key_and_source_are_refused(served):
    client, url, _ = served
    with pytest.raises(Refused, match="no stream with this name") as refused:
        client.stream("nobody")
    assert refused.value.status == 404
    with pytest.raises(Refused) as unknown, Client(url, "intrasplat_00000000_x") as stranger:
        stranger.streams()
    assert unknown.value.status == 401
    with pytest.raises(Refused, match=r"file|scheme|not allowed"):
        client.create_stream("spy", "file:///etc/passwd")


@pytest.fixture(scope="module")
def page(served):
    client, url, _ = served
    with chromium_by_playwright() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(1000 * WITHIN_S)
        said: list[str] = []
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on(
            "request",
            lambda request: said.append(request.url) if not request.url.startswith((url, "data:", "blob:")) else None,
        )
        page.goto(f"{url}/")
        page.fill("#key", client._key)
        page.keyboard.press("Enter")
        page.wait_for_selector("#state[data-state=live]")
        yield page
        assert said == [], "the page failed, or asked for something from elsewhere"


def brightness(page, canvas):
    """Return the mean of a canvas's values, from 0 to 255."""
    return page.evaluate(
        """(id) => { const canvas = document.getElementById(id);
        const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        return data.reduce((sum, value, index) => index % 4 < 3 ? sum + value : sum, 0) / (0.75 * data.length); }""",
        canvas,
    )


def test_console_shows_camera_and_reconstruction(page):
    # Both come by streams of their own: the first picture of one may come a moment after the other's.
    page.wait_for_function("raw.width === shown.width && raw.height === shown.height")
    assert page.evaluate("[raw.width, raw.height, shown.width, shown.height].join()") == "160,128,160,128"
    assert 30 < brightness(page, "raw") < 225 and abs(brightness(page, "raw") - brightness(page, "shown")) < 25


def test_console_stops_and_starts_stream(page):
    page.click("#tab-streams")
    page.click("#stream-rows >> text=Stop")
    page.click("#confirm-yes")
    page.wait_for_selector("#stream-rows >> text=stopped")
    page.wait_for_selector("#state:not([data-state=live])")
    page.click("#stream-rows >> text=Start")
    page.wait_for_selector("#state[data-state=live]")


def test_console_tabs_are_reachable_by_arrow_keys(page):
    page.focus("#tab-streams")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("#key-rows tr")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("#entries >> text=stream.start")
    page.keyboard.press("ArrowRight")
    page.wait_for_selector("#health-checks tr")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.id") == "tab-live" and page.is_visible("#raw")


def test_console_uploads_and_activates_model(page, walls):
    page.click("#tab-models")
    page.fill("#model-name", "from-the-page")
    page.set_input_files("#model-file", walls / "green.isplat")
    page.click("text=Upload")
    mine = page.locator("#versions tr", has_text="from-the-page")
    mine.get_by_text("Activate").click()
    mine.get_by_text("active").wait_for()


def test_console_shows_refusal_of_server(page):
    page.click("#tab-streams")
    page.fill("#stream-name", "spy")
    page.fill("#stream-source", "file:///etc/passwd")
    page.click("text=Start a stream")
    page.wait_for_selector("#problem:not([hidden])")
    assert "file" in page.inner_text("#problem") or "scheme" in page.inner_text("#problem")
