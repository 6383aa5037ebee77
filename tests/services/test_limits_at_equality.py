"""Limits of lengths and counts accept the limit itself and refuse one more."""

from __future__ import annotations

import asyncio
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from services.api import state, streams
from services.api.problems import Unprocessable
from services.auth import keys
from services.auth.keys import KeyConflict, KeyStore, Role, Tickets
from services.client import requests
from services.errors import ClientError, Rejected
from services.jobs import store as jobs
from services.recordings import check
from services.registry import models
from services.settings import SourceRules


def entry(parts: int) -> Any:
    info = zipfile.ZipInfo("/".join(["folder"] * (parts - 1) + ["0.png"]))
    return info


def submit(count: int) -> Any:
    """Submit replays of `count` recordings to a store without a database."""
    made = object.__new__(jobs.JobStore)
    try:
        made.submit([jobs.NewJob("r")] * count, {}, "operator")
    except AttributeError:  # it would look into the database now
        return None


LENGTHS: list[tuple[str, Callable[[int], Any], int, int, type[Exception]]] = [
    ("name of a caller", lambda n: models.check_by("x" * n), 1, models.MOST_BY, Rejected),
    ("key of a client", lambda n: requests.checked_key("x" * n), 1, requests.MOST_KEY_CHARACTERS, ClientError),
    ("folders of an archive", lambda n: check._check_entry(entry(n), 0), 1, check.MOST_PARTS, check.ArchiveInvalid),
    (
        "address of a source", lambda n: streams.check_source("synthetic:" + "x" * (n - 10), SourceRules()), 10,
        streams.MOST_LENGTH, Unprocessable,
    ),
    ("recordings at once", submit, 1, jobs.MOST_AT_ONCE, Rejected),
]  # fmt: skip


@pytest.mark.parametrize(("act", "least", "most", "refusal"), [each[1:] for each in LENGTHS], ids=[each[0] for each in LENGTHS])  # fmt: skip
def test_lengths_up_to_limit_are_accepted_and_longer_refused(
    act: Callable[[int], Any], least: int, most: int, refusal: type[Exception]
) -> None:
    act(least)
    act(most)
    with pytest.raises(refusal):
        act(most + 1)


@pytest.mark.parametrize("length", [0, 1])
def test_empty_names_keys_and_recording_lists_are_refused(length: int) -> None:
    for act, refusal in (
        (lambda: models.check_by("x" * length), Rejected), (lambda: requests.checked_key("x" * length), ClientError),
        (lambda: submit(length), Rejected),
    ):  # fmt: skip
        if length:
            act()
        else:
            with pytest.raises(refusal):
                act()


def token(number: int) -> str:
    return f"{keys.PREFIX}_{number:08d}_{'s' * 32}"


def test_key_store_limits_keys_per_name_total_keys_and_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "MOST_KEYS", keys.MOST_LIVE + 2)
    kept = KeyStore(tmp_path / "keys.json")
    names = ["wall"] * keys.MOST_LIVE + ["one", "two"]
    for number, name in enumerate(names):
        kept.add(name, Role.VIEWER, token=token(number))
        if number == keys.MOST_LIVE - 1:
            with pytest.raises(KeyConflict, match=f"wall has {keys.MOST_LIVE} keys"):
                kept.add("wall", Role.VIEWER, token=token(90))
    with pytest.raises(KeyConflict, match=f"there are {len(names)} keys"):
        kept.add("three", Role.VIEWER, token=token(91))
    other = KeyStore(tmp_path / "others.json")
    for count, is_taken in ((0, False), (1, True), (keys.MOST_STREAMS, True), (keys.MOST_STREAMS + 1, False)):
        limited = {"streams": [f"s{number}" for number in range(count)], "token": token(100 + count)}
        if is_taken:
            other.add(f"n{count}", Role.VIEWER, **limited)
        else:
            with pytest.raises(KeyConflict, match=f"and not to {count}"):
                other.add(f"n{count}", Role.VIEWER, **limited)


def test_tickets_over_limit_evict_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "MOST_TICKETS", 3)
    tickets = Tickets(60.0, clock=lambda: 0.0)
    made = [tickets.give(f"caller {number}", "/path") for number in range(4)]
    assert [tickets.use(each, "/path") for each in made] == [None, "caller 1", "caller 2", "caller 3"]


def test_token_buckets_over_limit_evict_least_recently_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "MOST_BUCKETS", 2)
    buckets = state.TokenBuckets(1, 60, clock=lambda: 0.0)
    for caller in ("a", "b", "a", "c"):
        buckets.wait_s(caller)
    assert list(buckets._buckets) == ["a", "c"]


def test_repeated_answers_over_limit_evict_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "MOST_KEPT", 2)
    made = []

    async def run() -> None:
        answers = state.Repeated()

        async def act() -> int:
            made.append(None)
            return len(made)

        given = [await answers.once("me", key, "asked", act) for key in ("a", "b", "a", "c", "b", "a")]
        assert given == [1, 2, 1, 3, 2, 4]

    asyncio.run(run())
