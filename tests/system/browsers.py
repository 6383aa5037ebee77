"""Headless browsers controlled by DevTools (Chromium) and WebDriver BiDi (Firefox)."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.missing import missing

START_S = 300.0
PROGRAMS = {"chromium": ("chromium", "chromium-browser", "google-chrome"), "firefox": ("firefox-esr", "firefox")}


def find(browser: str) -> str | None:
    """Return the path of a browser's program, or None if it is not installed."""
    return next((path for name in PROGRAMS[browser] if (path := shutil.which(name))), None)


def required(browser: str) -> str:
    """Return the path of a browser's program. If missing, skip the test; fail in CI."""
    path = find(browser)
    if path is None:
        missing(f"{browser} is not installed (Debian: apt-get install chromium firefox-esr)")
    return path


@contextmanager
def chromium_by_playwright() -> Iterator[Any]:
    """Chromium, driven by Playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright comes with the development packages")
    path = required("chromium")
    options = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=options)
        yield browser
        browser.close()


class Page:
    """Page of a running browser."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command of the browser's protocol and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=START_S))
            if answer.get("id") == self._number:
                assert "result" in answer, answer
                return answer["result"]

    def open(self, url: str) -> None:
        """Load a page completely."""
        raise NotImplementedError

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, or of its promise, as JSON."""
        raise NotImplementedError


class ChromiumPage(Page):
    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)
        while self.evaluate("document.readyState + location.href") != "complete" + url:
            time.sleep(0.1)

    def evaluate(self, expression: str) -> Any:
        answer = self.call(
            "Runtime.evaluate",
            expression=f"Promise.resolve({expression}).then(v => JSON.stringify(v ?? null))",
            awaitPromise=True,
        )
        assert "exceptionDetails" not in answer, answer
        return json.loads(answer["result"]["value"])


class FirefoxPage(Page):
    def __init__(self, socket: ClientConnection) -> None:
        super().__init__(socket)
        self.call("session.new", capabilities={})
        self._context = self.call("browsingContext.getTree")["contexts"][0]["context"]

    def open(self, url: str) -> None:
        self.call("browsingContext.navigate", context=self._context, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        answer = self.call(
            "script.evaluate",
            expression=f"Promise.resolve({expression}).then(v => JSON.stringify(v ?? null))",
            target={"context": self._context},
            awaitPromise=True,
        )
        assert answer["type"] == "success", answer
        return json.loads(answer["result"]["value"])


@contextmanager
def page(browser: str, profile: Path) -> Iterator[Page]:
    """Open a page of a browser with a temporary profile; the browser ends with the context."""
    program = find(browser)
    assert program is not None
    profile.mkdir(parents=True, exist_ok=True)
    log = profile / "log"
    options = ["--headless", "--remote-debugging-port=0"]
    if browser == "chromium":
        options += [f"--user-data-dir={profile}", "--no-sandbox", "--disable-gpu", "--no-first-run", "about:blank"]
    else:
        options += ["--no-remote", "--profile", str(profile), "about:blank"]
    with log.open("wb") as stream:
        process = subprocess.Popen([program, *options], stdout=stream, stderr=subprocess.STDOUT)
    try:
        address = _address(log, process)
        if browser == "chromium":
            with urlopen(re.sub(r"^ws(://[^/]+)/.*", r"http\1/json", address)) as answer:
                address = next(tab["webSocketDebuggerUrl"] for tab in json.load(answer) if tab["type"] == "page")
        else:
            address += "/session"
        with connect(address, max_size=None, compression=None) as socket:
            yield (ChromiumPage if browser == "chromium" else FirefoxPage)(socket)
    finally:
        process.terminate()
        try:
            process.wait(START_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _address(log: Path, process: subprocess.Popen) -> str:
    """Wait for the address that the browser logs once it listens, and return it."""
    end = time.monotonic() + START_S
    while time.monotonic() < end and process.poll() is None:
        if found := re.search(r"listening on (ws://\S+)", log.read_text(errors="replace")):
            return found[1]
        time.sleep(0.1)
    raise AssertionError(f"the browser did not start: {log.read_text(errors='replace')[-2000:]}")
