"""Claims: one owner per job for the duration of a lease."""

from __future__ import annotations

import threading

import pytest

from services.jobs import store as module
from services.jobs.store import Claims, JobProgress, JobState, NewJob

NOTHING = JobProgress(0, None, None)


@pytest.fixture
def clock(monkeypatch):
    """The wall clock in milliseconds, as a list of one number."""
    at = [1_000_000]
    monkeypatch.setattr(module, "_now_ms", lambda: at[0])
    return at


def claims_of(store, owner, most_attempts=3, published=()):
    return Claims(store.database, owner, 10, most_attempts, lambda folder: folder in published)


def submitted(store, count=1):
    return list(store.submit([NewJob(f"r{number}") for number in range(count)], {}, "operator").ids)


@pytest.mark.slow
def test_concurrent_claims_take_each_job_once(new_store):
    ids = submitted(new_store(), 20)
    taken = []

    def take_all(claims):
        while (claimed := claims.take()) is not None:
            taken.append(claimed.id)

    threads = [threading.Thread(target=take_all, args=(claims_of(new_store(), f"pool{n}"),)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(ids)


def test_renewed_lease_is_kept_and_expired_lease_is_lost(new_store, clock):
    store = new_store()
    (job_id,) = submitted(store)
    first, second = claims_of(store, "first"), claims_of(store, "second")
    assert first.take().attempt == 1
    clock[0] += 9_000
    assert first.renew({job_id: JobProgress(5, 9, 30.0)}).lost == frozenset() and second.take() is None
    assert (store.get(job_id).frames_done, store.get(job_id).frames, store.get(job_id).psnr_db) == (5, 9, 30.0)
    clock[0] += 11_000
    assert second.take().attempt == 2
    assert first.renew({job_id: NOTHING}).lost == {job_id}
    assert not first.end(job_id, JobState.DONE) and not first.give_back(job_id, counts=True)
    assert store.get(job_id).state is JobState.RUNNING
    assert second.end(job_id, JobState.DONE) and not second.end(job_id, JobState.FAILED, "again")
    assert store.get(job_id).state is JobState.DONE


def test_job_fails_after_most_attempts(new_store):
    store = new_store()
    (job_id,) = submitted(store)
    claims = claims_of(store, "pool", most_attempts=2)
    for _ in range(2):
        assert claims.take().id == job_id
        claims.give_back(job_id, counts=True)
    assert claims.take() is None
    assert store.get(job_id).state is JobState.FAILED and "begun 2 times" in store.get(job_id).reason


def test_give_back_without_counts_keeps_attempt_number(new_store):
    store = new_store()
    (job_id,) = submitted(store)
    claims = claims_of(store, "pool", most_attempts=1)
    for _ in range(3):
        assert claims.take().attempt == 1
        claims.give_back(job_id, counts=False)


def test_take_marks_published_job_done(new_store, clock):
    store = new_store()
    (job_id,) = submitted(store)
    claims_of(store, "dies between its rename and its note").take()
    clock[0] += 11_000
    assert claims_of(store, "next", published={job_id}).take() is None
    assert store.get(job_id).state is JobState.DONE


def test_renew_reports_cancelled_jobs(new_store):
    store = new_store()
    (job_id,) = submitted(store)
    claims = claims_of(store, "pool")
    claims.take()
    store.cancel(job_id, "nurse")
    assert claims.renew({job_id: NOTHING}).cancelled == {job_id: "nurse"}
    claims.give_back(job_id, counts=True)  # it died before it was ended
    assert claims.take() is None and store.get(job_id).state is JobState.CANCELLED


def test_free_releases_jobs_of_dead_owners(new_store):
    store = new_store()
    submitted(store, 2)
    claims_of(store, "dead").take()
    claims_of(store, "alive").take()
    next_one = claims_of(store, "next")
    assert next_one.take() is None
    next_one.free(["dead"])
    assert next_one.take().attempt == 2 and next_one.take() is None
