"""The video of `report.html` plays in Chromium and Firefox with correct colours."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import av
import numpy as np
import pytest

from tests.system.browsers import PROGRAMS, Page, page, required

pytestmark = pytest.mark.slow

STATE = "(() => { const v = document.querySelector('video'); return [v.readyState, v.currentTime, v.videoWidth, v.error && v.error.message]; })()"
PIXELS = """(async () => {
  const video = document.querySelector('video');
  while (video.readyState < 2) await new Promise(done => setTimeout(done, 50));
  const canvas = document.createElement('canvas'); canvas.width = video.videoWidth; canvas.height = video.videoHeight;
  const context = canvas.getContext('2d'); context.drawImage(video, 0, 0);
  return Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data);
})()"""


@pytest.fixture(scope="module", params=sorted(PROGRAMS))
def browser(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page of a running browser. If it is not installed, the test is skipped; in CI it fails."""
    required(request.param)
    with page(request.param, tmp_path_factory.mktemp(request.param)) as opened:
        yield opened


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(finished: Path) -> Iterator[str]:
    """The output folder over HTTP, because a canvas may not read files."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(finished))) as httpd:
        thread = threading.Thread(target=httpd.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{httpd.server_port}"
        httpd.shutdown()
        thread.join()


def test_report_video_plays_in_browser(browser: Page, finished: Path) -> None:
    browser.open((finished / "report.html").as_uri())
    browser.evaluate("document.querySelector('video').play()")
    end, states = time.monotonic() + 300, []
    # A frame is there, and time goes on; between two rounds of so short a video the player has none for a moment.
    while time.monotonic() < end and not any(state >= 2 and time_s > 0 for state, time_s, *_ in states):
        states.append(browser.evaluate(STATE))
    assert any(state >= 2 and time_s > 0 and width > 0 for state, time_s, width, _ in states), states[-1]
    assert all(error is None for *_, error in states)


def test_report_video_first_frame_colours_match_file(browser: Page, finished: Path, server: str) -> None:
    with av.open(str(finished / "reconstruction.mp4")) as container:
        expected = next(container.decode(video=0)).to_ndarray(format="rgb24")
    browser.open(f"{server}/report.html")
    shown = np.array(browser.evaluate(PIXELS), np.int16).reshape(*expected.shape[:2], 4)[..., :3]
    assert np.abs(shown - expected).mean() < 4
    assert expected.std() > 20  # a picture in one colour would prove little
