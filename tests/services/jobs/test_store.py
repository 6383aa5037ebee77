"""The job store: submission, idempotency keys, listing, cancellation, removal."""

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


def test_job_migrations_create_tables_of_metadata(new_store):
    with new_store().database.reading() as connection:
        context = MigrationContext.configure(connection, opts={"version_table": SCHEMA.version_table})
        assert compare_metadata(context, METADATA) == []


def test_submit_creates_one_job_per_recording_in_one_batch(new_store):
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


def test_submit_with_same_idempotency_key_creates_one_batch(new_store):
    store = new_store()
    first = store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "operator", "key")
    again = store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "operator", "key")
    assert (again.batch, list(again.ids), first.is_new, again.is_new) == (first.batch, list(first.ids), True, False)
    for recordings, options in (("ba", {"seed": 3}), ("ab", {"seed": 4}), ("a", {"seed": 3})):
        with pytest.raises(Rejected, match="another request"):
            store.submit([NewJob(name) for name in recordings], options, "operator", "key")
    assert store.submit([NewJob("a"), NewJob("b")], {"seed": 3}, "another caller", "key").is_new
    assert store.counts()["queued"] == 4


def test_concurrent_submits_with_same_key_create_one_batch(new_store):
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


def test_submit_creates_no_jobs_if_any_recording_is_missing(store):
    def find(connection, name):
        raise NotFound(f"there is no recording {name}")

    store._find_source = find
    with pytest.raises(NotFound, match="no recording b"):
        store.submit([NewJob("a", "/r/a"), NewJob("b")], {}, "operator", "key")
    assert store.newest() == []
    for count in (0, MOST_AT_ONCE + 1):
        with pytest.raises(Rejected, match="name 1 to"):
            store.submit([NewJob("a")] * count, {}, "operator")


def test_cancel_and_forget_follow_job_state(new_store):
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


def test_surplus_lists_jobs_over_age_or_count_limit(new_store, monkeypatch):
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


def test_uses_recording_is_true_until_its_jobs_ended(new_store):
    store = new_store()
    (job_id,) = store.submit([NewJob("a")], {}, "operator").ids

    def used(name):
        with store.database.writing() as connection:
            return uses_recording(connection, name)

    assert used("a") and not used("b")
    store.cancel(job_id, "operator")
    assert not used("a")


def test_job_options_chosen_omits_defaults():
    assert JobOptions(seed=0, scale=0.5).chosen() == {"scale": 0.5}
    assert JobOptions().chosen() == {}
