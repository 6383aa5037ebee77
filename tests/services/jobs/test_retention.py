"""Expired recordings and replays are removed and written to the audit log."""

from __future__ import annotations

import asyncio

from services.jobs.results import Replays, Results
from services.jobs.store import JobStore, NewJob
from services.recordings.store import Expired
from services.retention import DAY_S, RecordingRetention, ReplayRetention


class FakeStore:
    """Recording store that records its calls."""

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
    """Audit log that records its events in memory."""

    def __init__(self):
        self.entries = []

    def tell(self, event, subject, outcome="done", **detail):
        self.entries.append((event, subject, outcome, detail))


def test_recording_retention_checks_pending_and_expires_old_at_start():
    store, events = FakeStore([Expired("case-1", "it is older than 2 days")]), FakeEvents()
    retention = RecordingRetention(store, 2, 10**9, events)

    async def serve():
        async with retention.running():
            while not (events.entries and store.checked):
                await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(serve(), 300))
    assert store.asked == [(2 * DAY_S, 10**9)] and store.checked == ["waits"] and store.closed
    assert events.entries == [("recording.expire", "case-1", "done", {"why": "it is older than 2 days"})]


def test_recording_retention_without_bounds_expires_nothing():
    store = FakeStore([Expired("case-1", "")])
    asyncio.run(RecordingRetention(store, None, None, FakeEvents()).enforce())
    assert store.asked == []


def test_replay_retention_removes_surplus_ended_replays_and_results(tmp_path):
    store = JobStore(f"sqlite:///{tmp_path / 'jobs.sqlite'}", lambda _, name: tmp_path / name)
    results, events = Results(tmp_path / "results"), FakeEvents()
    ids = store.submit([NewJob(name) for name in "abc"], {}, "operator").ids
    for job_id in ids[:2]:
        store.cancel(job_id, "nurse")
        (results.folder / job_id).mkdir()
    retention = ReplayRetention(Replays(store, results), None, 1, events)

    async def serve():
        async with retention.running():
            while not events.entries:
                await asyncio.sleep(0.01)

    asyncio.run(asyncio.wait_for(serve(), 300))
    assert [(event, subject) for event, subject, _, _ in events.entries] == [("replay.expire", ids[0])]
    assert [job.id for job in store.newest()] == [ids[2], ids[1]]
    assert not (results.folder / ids[0]).exists() and (results.folder / ids[1]).exists()
    asyncio.run(ReplayRetention(Replays(store, results), None, None, events).enforce())
    assert len(store.newest()) == 2
    store.close()
