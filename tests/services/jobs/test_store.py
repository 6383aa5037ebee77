"""The store of jobs: submitting, once for each idempotency key, listing, cancelling, forgetting."""

from __future__ import annotations

import threading
from datetime import timedelta

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext

from operators.settings import JobOptions
from services.errors import Conflict, NotFound, Rejected
from services.jobs.store import DAY_S, METADATA, MOST_AT_ONCE, SCHEMA, Claims, JobState, NewJob, uses_recording
from services.registry import records


def test_the_migrations_make_the_tables_that_the_program_uses(new_store):
    with new_store().database.reading() as connection:
        context = MigrationContext.configure(connection, opts={"version_table": SCHEMA.version_table})
        assert compare_metadata(context, METADATA) == []


def test_a_batch_is_one_job_for_each_recording(new_store):
    store = new_store()
    made = store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "operator")
    jobs = store.newest()
    assert [job.id for job in reversed(jobs)] == list(made.ids) and {job.batch for job in jobs} == {made.batch}
    assert [(job.recording, job.state, job.options) for job in reversed(jobs)] == [
        ("a", JobState.QUEUED, {"seed": 3}), ("b", JobState.QUEUED, {"seed": 3}),
    ]  # fmt: skip
    other = store.submit([NewJob("c")], {}, "operator")
    assert store.counts(made.batch)["queued"] == 2 and store.counts()["queued"] == 3
    assert [job.recording for job in store.newest(batch=other.batch)] == ["c"]
    assert [job.recording for job in store.newest(2)] == ["c", "b"]
    assert [job.recording for job in store.newest(before=jobs[0].number)] == ["a"]
    assert store.newest(state="done") == []


def test_one_idempotency_key_makes_one_batch(new_store):
    store = new_store()
    first = store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "operator", "key")
    again = store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "operator", "key")
    assert (again.batch, list(again.ids), first.is_new, again.is_new) == (first.batch, list(first.ids), True, False)
    for recordings, options in (("ba", {"seed": 3}), ("ab", {"seed": 4}), ("a", {"seed": 3})):
        with pytest.raises(Rejected, match="another request"):
            store.submit([NewJob(name) for name in recordings], options, "operator", "key")
    assert store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "another caller", "key").is_new
    assert store.counts()["queued"] == 4


def test_many_requests_at_once_with_one_key_make_one_batch(new_store):
    stores = [new_store() for _ in range(4)]
    batches = []
    threads = [
        threading.Thread(target=lambda s=s: batches.append(s.submit([NewJob("a")], {}, "operator", "key").batch))
        for s in stores
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(batches)) == 1 and stores[0].counts()["queued"] == 1


def test_all_recordings_or_none(store):
    def find(connection, name):
        raise NotFound(f"there is no recording {name}")

    store._find_source = find
    with pytest.raises(NotFound, match="no recording b"):
        store.submit([NewJob("a", "/r/a"), NewJob("b")], {}, "operator", "key")
    assert store.newest() == []
    for count in (0, MOST_AT_ONCE + 1):
        with pytest.raises(Rejected, match="name 1 to"):
            store.submit([NewJob("a")] * count, {}, "operator")


def test_cancelling_and_forgetting(new_store):
    store = new_store()
    queued, running = store.submit([NewJob("a"), NewJob("b")], {}, "operator").ids
    store.cancel(queued, "nurse")
    assert (store.get(queued).state, store.get(queued).reason) == (JobState.CANCELLED, "cancelled by nurse")
    claims = Claims(store.database, "pool", 10, 3, lambda folder: False)
    assert claims.take().id == running
    assert store.cancel(running, "nurse").state is JobState.RUNNING  # until its pool hears of it
    with pytest.raises(Conflict, match="cancel it first"):
        store.forget(running)
    with pytest.raises(Conflict, match="cancelled and cannot be"):
        store.cancel(queued, "nurse")
    store.forget(queued)
    with pytest.raises(NotFound):
        store.get(queued)


def test_what_ended_too_long_ago_or_is_too_much(new_store, monkeypatch):
    store = new_store()
    ids = store.submit([NewJob(name) for name in "abcde"], {}, "operator").ids
    began = records.now()
    for days, job_id in enumerate(ids[:4]):
        monkeypatch.setattr("services.jobs.store.now", lambda days=days: began + timedelta(days=days))
        store.cancel(job_id, "nurse")  # ended on day 0, 1, 2, 3; the fifth has not
    monkeypatch.setattr("services.jobs.store.now", lambda: began + timedelta(days=4))
    assert store.surplus(None, None) == store.surplus(5 * DAY_S, 4) == []
    assert store.surplus(2.5 * DAY_S, None) == [
        (ids[1], "it ended 3.0 days ago; 2.5 are kept"),
        (ids[0], "it ended 4.0 days ago; 2.5 are kept"),
    ]
    assert [job_id for job_id, _ in store.surplus(None, 1)] == [ids[2], ids[1], ids[0]]
    assert [why.partition(" ")[0] for _, why in store.surplus(3.5 * DAY_S, 1)] == ["1", "2", "it"]


def test_a_recording_is_in_use_until_its_jobs_have_ended(new_store):
    store = new_store()
    (job_id,) = store.submit([NewJob("a")], {}, "operator").ids

    def used(name):
        with store.database.writing() as connection:
            return uses_recording(connection, name)

    assert used("a") and not used("b")
    store.cancel(job_id, "operator")
    assert not used("a")


def test_options_that_are_defaults_are_not_kept():
    assert JobOptions(seed=0, scale=0.5).chosen() == {"scale": 0.5}
    assert JobOptions().chosen() == {}
