"""Recordings that go by themselves are in the audit log."""

from __future__ import annotations

import asyncio

from services.recordings.records import Expired
from services.server.retention import DAY_S, KeptRecordings


class FakeStore:
    """Notes what it is asked for."""

    def __init__(self, expired):
        self.expired, self.asked, self.checked, self.closed = expired, [], [], False

    def recover(self):
        return ["waits"]

    def check(self, name):
        self.checked.append(name)

    def expire(self, max_age_s, max_bytes):
        self.asked.append((max_age_s, max_bytes))
        found, self.expired = self.expired, []
        return found

    def close(self):
        self.closed = True


class FakeEvents:
    """Notes what it is told."""

    def __init__(self):
        self.told = []

    def tell(self, event, subject, outcome="done", **detail):
        self.told.append((event, subject, outcome, detail))


def test_at_start_what_waits_is_checked_and_what_is_too_old_goes():
    store, events = FakeStore([Expired("case-1", "it is older than 2 days")]), FakeEvents()
    kept = KeptRecordings(store, 2, 10**9, events)

    async def serve():
        async with kept.kept():
            while not (events.told and store.checked):
                await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(serve(), 20))
    assert store.asked == [(2 * DAY_S, 10**9)] and store.checked == ["waits"] and store.closed
    assert events.told == [("recording.expire", "case-1", "done", {"why": "it is older than 2 days"})]


def test_without_bounds_nothing_goes():
    store = FakeStore([Expired("case-1", "")])
    asyncio.run(KeptRecordings(store, None, None, FakeEvents()).enforce())
    assert store.asked == []
