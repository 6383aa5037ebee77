"""The console in a browser: confirmation of deletions, keys, audit log, health, and layout of the live page."""

from __future__ import annotations

import csv
import io
import json
import re
import tempfile
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from services.client import Client
from services.schemas import KeyView
from tests.system.browsers import chromium_by_playwright
from tests.system.servers import serving

pytestmark = pytest.mark.slow

WINDOWS = {"theatre": (1920, 1080), "laptop": (1280, 800), "tablet": (1024, 768), "phone": (390, 844)}
CUT = """() => [...document.querySelectorAll("#live canvas, #live figcaption, #live button, header *:not(:empty)")].filter((each) => {
  if (each.checkVisibility && !each.checkVisibility()) return false;
  const box = each.getBoundingClientRect();
  return box.top < 0 || box.left < 0 || box.bottom > innerHeight + 0.5 || box.right > innerWidth + 0.5 || box.width < 1 || box.height < 1;
}).map((each) => `${each.tagName} ${each.id} ${JSON.stringify(each.getBoundingClientRect())}`)"""


@pytest.fixture(scope="module")
def console() -> Iterator[tuple[Any, Client]]:
    """The console of a server with a stopped stream, signed in as administrator, and a client. Fails on page errors."""
    with (
        chromium_by_playwright() as browser,
        tempfile.TemporaryDirectory(prefix="isc-") as folder,
        serving(Path(folder)) as (url, key),
        Client(url, key) as client,
    ):
        said: list[str] = []
        page = browser.new_page(timezone_id="Asia/Tokyo", accept_downloads=True)
        page.set_default_timeout(300_000)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(f"{url}/#key={key}")
        page.wait_for_selector("#account:not([hidden])")
        yield page, client
        assert said == []


@pytest.fixture
def page(console):
    """The console page. Checks that the test leaves no dialog open."""
    page, _ = console
    yield page
    assert page.locator("dialog[open]").count() == 0


@pytest.fixture
def client(console) -> Client:
    return console[1]


def listed(client: Client) -> list[KeyView]:
    return client.keys()


def wait_until(page: Any, true: str) -> None:
    """Wait until an expression is true. Playwright's wait needs `eval`, which the page's policy forbids."""
    for _ in range(6000):
        if page.evaluate(true):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"condition not met in time: {true}")


def opened(page: Any, tab: str) -> None:
    page.click(f"#tab-{tab}")
    page.wait_for_selector(f"#{tab}:not([hidden])")


@pytest.mark.parametrize("window", WINDOWS)
def test_live_page_fits_window(page, window):
    width, height = WINDOWS[window]
    page.set_viewport_size({"width": width, "height": height})
    opened(page, "live")
    page.wait_for_selector("#take-snapshot")
    wait_until(page, "Math.abs(document.getElementById('age').width - document.getElementById('age').clientWidth) < 2")
    assert page.evaluate(CUT) == []
    assert page.evaluate(
        "[document.documentElement.scrollHeight <= innerHeight, live.scrollHeight <= live.clientHeight + 1]"
    ) == [True, True]
    shares = page.evaluate("['raw', 'age'].map((id) => document.getElementById(id).clientHeight / innerHeight)")
    assert shares[0] > (0.15 if window == "phone" else 0.35), "the pictures are what the page is for"
    assert shares[1] > 0.05
    text = page.inner_text("#live .plots")
    assert "displayed frame, training error" in text
    page.set_viewport_size({"width": 1280, "height": 800})


def test_live_page_shows_reason_of_stream_without_picture(page, client):
    opened(page, "live")
    assert page.is_hidden("#stream-reason")
    reason = "nothing is shown: of 45 frames 45 were withheld (out of body: 45)"
    view = {**client.stream("theatre-1").model_dump(mode="json"), "state": "starting", "reason": reason}
    page.route("**/v1/streams", lambda route: route.fulfill(json=[view]))
    page.wait_for_selector("#stream-reason:not([hidden])")
    assert page.inner_text("#stream-reason") == f"starting: {reason}"
    page.unroute("**/v1/streams")
    page.wait_for_selector("#stream-reason", state="hidden")


def test_console_quality_text_includes_baseline_scores(page):
    texts = page.evaluate(
        """async () => { const { quality } = await import("/console/streams.js");
        return [quality({ psnr_db: 35.71 }), quality({ psnr_db: 35.71, previous_frame_db: 38 }),
                quality({ psnr_db: 35.7, previous_frame_db: 38.02, next_frame_db: 33.3 }), quality({ psnr_db: null }), quality({})]; }"""
    )
    assert texts == ["35.7", "35.7 (previous frame 38.0)", "35.7 (previous frame 38.0, next frame 33.3)", "", ""]


def test_console_delete_requires_confirmation(page, client):
    client.create_stream("spare", "synthetic:?width=64&height=48&frames=4", device="cpu", start=False)
    opened(page, "streams")
    delete = page.get_by_role("button", name="Delete the stream spare")
    for refuse in ("Enter", "Escape"):  # the button that has the focus is Cancel
        delete.focus()
        page.keyboard.press("Enter")
        page.wait_for_selector("#confirm[open]")
        assert page.evaluate("document.activeElement.id") == "confirm-no"
        assert "Delete the stream spare?" in page.inner_text("#confirm-title")
        assert "synthetic:" in page.inner_text("#confirm-what")
        assert "cannot be undone" in page.inner_text("#confirm-consequence")
        page.keyboard.press(refuse)
        page.wait_for_selector("#confirm:not([open])", state="attached")
        wait_until(page, "document.activeElement.getAttribute('aria-label') === 'Delete the stream spare'")
    assert client.stream("spare").state == "stopped"
    page.keyboard.press("Enter")
    page.wait_for_selector("#confirm[open]")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "confirm-yes"
    page.keyboard.press("Enter")
    page.locator("#stream-rows tr", has_text="spare").wait_for(state="detached")
    assert [stream.name for stream in client.streams()] == ["theatre-1"]


def test_console_modules_confirm_every_delete(page):
    """Every deletion and revocation in the modules passes through the confirmation dialog."""
    folder = Path(__file__).resolve().parents[2] / "services" / "console" / "page"
    asking = {}
    for module in sorted(folder.glob("*.js")):
        text = module.read_text()
        deletes = len(re.findall(r'call\("DELETE"', text))
        if deletes:
            asking[module.stem] = (deletes, len(re.findall(r"consequence:", text)))
    assert asking.keys() == {"keys", "models", "recordings", "replays", "streams"}
    assert all(questions >= deletes for deletes, questions in asking.values()), asking


def test_console_delete_dialog_names_recording(page, client, tmp_path):
    import zipfile

    from gsplat_core.io.recordings import synthesize

    folder = synthesize(tmp_path / "tiny", frames=3, width_px=64, height_px=48, stereo=False)
    with zipfile.ZipFile(tmp_path / "tiny.zip", "w") as archive:
        for file in folder.rglob("*"):
            archive.write(file, f"tiny/{file.relative_to(folder)}")
    client.upload_recording("case-7", tmp_path / "tiny.zip")
    client.checked_recording("case-7")
    opened(page, "recordings")
    mine = page.locator("#recording-rows tr", has_text="case-7")
    assert client.recording("case-7").digest[:12] in mine.inner_text()
    page.get_by_role("button", name="Delete the recording case-7").click()
    assert "case-7" in page.inner_text("#confirm-title") and "3 frames of 64×48" in page.inner_text("#confirm-what")
    page.click("#confirm-yes")
    mine.wait_for(state="detached")
    assert client.recordings() == []


def test_console_creates_shows_once_and_revokes_keys(page, client):
    opened(page, "keys")
    page.fill("#key-name", "wall")
    page.select_option("#key-expires", "7")
    page.fill("#key-streams", "theatre-1, theatre-2")
    page.keyboard.press("Enter")
    page.wait_for_selector("#made-key[open]")
    secret = page.input_value("#made-key-secret")
    (made,) = [key for key in listed(client) if key.name == "wall"]
    assert secret.startswith(f"intrasplat_{made.id}_") and made.streams == ["theatre-1", "theatre-2"]
    days = (datetime.fromisoformat(made.expires_at) - datetime.fromisoformat(made.created_at)).total_seconds() / 86400
    assert days == pytest.approx(7, abs=0.01)
    page.click("#made-key >> text=Close")
    wait_until(page, "document.getElementById('made-key-secret').value === ''")
    assert secret not in page.content()
    line = page.locator("#key-rows tr", has_text="wall")
    assert made.id in line.inner_text() and "theatre-1, theatre-2" in line.inner_text() and "never" in line.inner_text()
    assert "(this page)" in page.inner_text("#key-rows tr >> nth=0")
    page.get_by_role("button", name=f"Revoke the key wall {made.id}").click()
    assert made.id in page.inner_text("#confirm-what")
    page.click("#confirm-yes")
    line.wait_for(state="detached")
    assert "wall" not in [key.name for key in listed(client)]


def test_console_filters_and_saves_audit_log(page, client, tmp_path):
    client.revoke_key(client.make_key("for-a-while", "viewer").id)
    opened(page, "audit")
    page.wait_for_selector("#entries >> text=key.revoke")
    everything = page.locator("#entries tr").count()
    page.fill("#audit-event", "key")
    page.fill("#audit-subject", "for-a-while")
    page.keyboard.press("Enter")
    wait_until(page, "[...document.querySelectorAll('#entries tr')].length === 1")
    assert everything > 3 and "key.create" in page.inner_text("#entries")
    stamp = page.locator("#entries time").first
    assert "GMT+9" in stamp.inner_text() or "JST" in stamp.inner_text()
    assert stamp.get_attribute("title").endswith(" UTC")
    files = {}
    for form in ("csv", "jsonl"):
        with page.expect_download() as started:
            page.click(f"#save-{form}")
        files[form] = tmp_path / started.value.suggested_filename
        started.value.save_as(files[form])
        assert files[form].suffix == f".{form}"
    (row,) = csv.DictReader(io.StringIO(files["csv"].read_text()))
    (entry,) = [json.loads(line) for line in files["jsonl"].read_text().splitlines()]
    assert row["event"] == entry["event"] == "key.create" and row["at"] == entry["at"]
    page.fill("#audit-since", "2099-01-01T00:00:00")
    page.click("#audit-filter >> text=Filter")
    page.wait_for_selector("#audit-said >> text=no matching entries")
    page.click("#audit-filter >> text=Clear")
    wait_until(page, f"document.querySelectorAll('#entries tr').length >= {everything}")


def test_console_health_page_matches_readyz(page, client):
    opened(page, "health")
    page.wait_for_selector("#health-checks tr")
    ready = client.ready()
    shown = page.inner_text("#health-checks")
    # The free space changes between the two readings.
    without_numbers = lambda text: re.sub(r"\d+", "0", text)
    for name, check in (ready.checks or {}).items():
        assert name.replace("_", " ") in shown and without_numbers(check.detail) in without_numbers(shown)
    assert ready.status in page.inner_text("#health-status")
    assert client.about()["version"] in page.inner_text("#health-versions")
    assert "theatre-1" in page.inner_text("#health-streams")
    answer = {"status": "not ready", "checks": {"disk": {"ok": False, "detail": "3 MiB free", "needed": True}}}
    page.route("**/readyz?verbose", lambda route: route.fulfill(status=503, json=answer))
    opened(page, "health")
    page.wait_for_selector("#health-checks >> text=failed, required")
    assert page.inner_text("#health-status") == "not ready" and "3 MiB free" in page.inner_text("#health-checks")
    page.unroute("**/readyz?verbose")


def test_console_shows_tabs_of_role_and_signs_out(console):
    page, client = console
    assert "role admin" in page.inner_text("#account")
    other = page.context.browser.new_page()
    made = client.make_key("room", "viewer", streams=["theatre-1"])
    other.goto(f"{client.url}/#key={made.key}")
    other.wait_for_selector("#account:not([hidden])")
    assert "room" in other.inner_text("#account") and "role viewer, only theatre-1" in other.inner_text("#account")
    offered = other.eval_on_selector_all(
        "[role=tab]", "all => all.filter((tab) => !tab.hidden).map((tab) => tab.textContent)"
    )
    assert offered == ["Live", "Streams", "Health"]
    other.focus("#tab-live")
    for _ in range(3):
        other.keyboard.press("ArrowRight")
    assert other.evaluate("document.activeElement.id") == "tab-live", "hidden pages are passed over"
    other.click("#sign-out")
    other.wait_for_selector("#sign-in[open]")
    assert other.evaluate("sessionStorage.getItem('intrasplat-key')") is None
    client.revoke_key(made.id)
    other.fill("#key", made.key)
    other.keyboard.press("Enter")
    other.wait_for_selector("#sign-in-reason >> text=not known")
    other.fill("#key", client._key)
    other.keyboard.press("Enter")
    other.wait_for_selector("#account >> text=role admin")
    other.close()
