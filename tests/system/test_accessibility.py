"""Accessibility of the console: axe-core's WCAG 2.1 AA rules, contrast and keyboard use."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.system.browsers import chromium_by_playwright
from tests.system.servers import serving

pytestmark = pytest.mark.slow

axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="it comes with the development packages")
STATES = ("live", "stale", "frozen", "source lost", "no connection", "no picture", "virtual")


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    """The console of a server with a stopped stream, before sign-in, and the administrator's key."""
    with (
        chromium_by_playwright() as browser,
        tempfile.TemporaryDirectory(prefix="isa-") as folder,
        serving(Path(folder)) as (url, key),
    ):
        page = browser.new_page(viewport={"width": 1920, "height": 1080})
        page.set_default_timeout(300_000)
        page.goto(f"{url}/")
        page.wait_for_selector("#sign-in[open]")
        yield page, key


def violations(page: Any, rules: list[str] | None = None, within: str | None = None) -> list[str]:
    """Return axe-core's violations, one line per element."""
    wanted = (
        {"type": "rule", "values": rules}
        if rules
        else {"type": "tag", "values": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}
    )
    found = axe.Axe().run(page, context=within, options={"runOnly": wanted}).response
    assert found["passes"], "axe-core has looked at nothing"
    return [
        f"{each['id']}: {node['html']} {node['failureSummary']}"
        for each in found["violations"]
        for node in each["nodes"]
    ]


def test_sign_in_dialog_is_accessible_and_usable_by_keyboard(page):
    page, key = page
    assert violations(page) == []
    assert page.evaluate("document.activeElement.id") == "key"
    page.keyboard.type(key)
    page.keyboard.press("Enter")
    page.wait_for_selector("#sign-in:not([open])", state="attached")
    page.wait_for_selector("#stream-rows tr", state="attached")


def test_every_console_tab_passes_axe(page):
    page, _ = page
    tabs = page.eval_on_selector_all("[role=tab]", "all => all.map((tab) => tab.getAttribute('aria-controls'))")
    assert {"live", "models", "streams", "audit"} <= set(tabs)
    for tab in tabs:
        page.click(f"#tab-{tab}")
        page.wait_for_selector(f"#{tab}:not([hidden])")
        page.wait_for_timeout(100)
        assert violations(page) == [], tab


def test_console_error_message_is_accessible(page):
    page, _ = page
    page.click("#tab-streams")
    page.fill("#stream-name", "spy")
    page.fill("#stream-source", "file:///etc/passwd")
    page.keyboard.press("Enter")
    page.wait_for_selector("#problem:not([hidden])")
    assert page.get_attribute("#problem", "role") == "alert"
    assert violations(page) == []


def test_badges_of_all_states_have_sufficient_contrast(page):
    """Includes states that axe-core does not encounter and badges of pictures."""
    page, _ = page
    page.click("#tab-live")
    for state in STATES:
        page.evaluate(
            """(state) => { for (const each of document.querySelectorAll("#state, .badge")) {
            const copy = each.cloneNode(true);  // the page itself goes on changing its own
            copy.removeAttribute("id"); copy.dataset.state = state; copy.textContent = state; copy.classList.add("copied");
            each.after(copy); } }""",
            state,
        )
    assert page.locator(".copied").count() >= 2 * len(STATES)
    assert violations(page, ["color-contrast"]) == []
    page.evaluate("document.querySelectorAll('.copied').forEach((each) => each.remove())")


def test_console_controls_are_reachable_by_keyboard(page):
    page, _ = page
    for tab, needed in (("models", "model-file"), ("streams", "stream-source"), ("audit", "tab-audit")):
        page.focus(f"#tab-{tab}")
        page.keyboard.press("Enter")
        page.wait_for_selector(f"#{tab}:not([hidden])")
        reached = set()
        for _ in range(40):
            reached.add(page.evaluate("document.activeElement.id"))
            page.keyboard.press("Tab")
        assert {needed, "stream"} <= reached, reached
    page.focus("#tab-models")
    assert "3px" in page.evaluate("getComputedStyle(document.querySelector('#tab-models:focus-visible')).outlineWidth")
