"""The pool: published results, and attempts that fail, die, are cancelled or lose their claim."""

from __future__ import annotations

import json

import pytest

from services.errors import StoreUnavailable
from services.jobs.pool import JobPool
from services.jobs.results import RUNNING
from services.jobs.store import JobState, NewJob


def submitted(store, count=1):
    return list(store.submit([NewJob(f"r{number}") for number in range(count)], {"seed": 1}, "operator").ids)


def result(tmp_path, job_id):
    return json.loads((tmp_path / "results" / job_id / "report.json").read_text())


def attempts_left(tmp_path):
    return [path.name for path in (tmp_path / "results" / RUNNING).glob("*/*") if path.is_dir()]


def test_pool_runs_at_most_workers_attempts_and_publishes_results(store, runner, new_pool, tmp_path):
    ids = submitted(store, 3)
    pool = new_pool(workers=2, threads=3, niceness=4, pack_models=True)
    pool.step()
    assert list(runner.tasks) == ids[:2]
    task = runner.tasks[ids[0]]
    assert (task.source, task.options, task.threads, task.niceness, task.pack_model) == (
        "/r/r0",
        {"seed": 1},
        3,
        4,
        True,
    )
    runner.finish(ids[1])
    pool.step()
    assert set(runner.tasks) == {ids[0], ids[2]} and result(tmp_path, ids[1]) == "made"
    done = store.get(ids[1])
    assert (done.state, done.frames_done, done.frames, done.psnr_db, done.attempts) == (JobState.DONE, 3, 3, 31.5, 1)
    assert len(attempts_left(tmp_path)) == 2


def test_failed_job_keeps_reason_and_is_not_retried(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    pool = new_pool()
    pool.step()
    runner.tasks[job_id].say_outcome(JobState.FAILED, "the recording is empty")
    runner.die(job_id, "exit code 0")
    pool.step()
    pool.step()
    assert (store.get(job_id).state, store.get(job_id).reason) == (JobState.FAILED, "the recording is empty")
    assert runner.tasks == {} and attempts_left(tmp_path) == []


def test_killed_attempt_is_retried_up_to_most_attempts(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    pool = new_pool(most_attempts=2)
    for _ in range(2):
        pool.step()
        runner.die(job_id, "killed by SIGKILL")
        pool.step()
    assert store.get(job_id).state is JobState.FAILED and attempts_left(tmp_path) == []


def test_cancelled_job_is_killed_and_leaves_no_files(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    pool = new_pool()
    pool.step()
    store.cancel(job_id, "nurse")
    pool.step()
    assert runner.killed == [job_id]
    pool.step()
    assert store.get(job_id).state is JobState.CANCELLED and attempts_left(tmp_path) == []
    assert not (tmp_path / "results" / job_id).exists()


def test_attempt_with_lost_claim_is_not_published(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    slow, other = new_pool(), type(runner)()
    slow.step()
    store.retry([JobState.RUNNING])  # as at the end of a lease
    next_pool = new_pool(runner=other)
    next_pool.step()
    runner.finish(job_id, "too late")
    slow.step()
    assert not (tmp_path / "results" / job_id).exists()
    other.finish(job_id, "in time")
    next_pool.step()
    assert result(tmp_path, job_id) == "in time" and store.get(job_id).state is JobState.DONE


def test_existing_result_is_kept_and_job_is_done(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    pool = new_pool()
    pool.step()
    (tmp_path / "results" / job_id).mkdir()
    (tmp_path / "results" / job_id / "report.json").write_text('"first"')
    runner.finish(job_id, "second")
    pool.step()
    assert result(tmp_path, job_id) == "first" and store.get(job_id).state is JobState.DONE


def test_job_fails_if_result_folder_holds_other_files(store, runner, new_pool, tmp_path):
    (job_id,) = submitted(store)
    pool = new_pool()
    pool.step()
    (tmp_path / "results" / job_id).mkdir()
    (tmp_path / "results" / job_id / "mine").write_text("x")
    runner.finish(job_id)
    pool.step()
    assert store.get(job_id).state is JobState.FAILED and "something else" in store.get(job_id).reason
    assert (tmp_path / "results" / job_id / "mine").read_text() == "x"


def test_ending_pool_publishes_finished_and_requeues_running_jobs(store, runner, new_pool, tmp_path):
    ids = submitted(store, 2)
    pool = new_pool(workers=2)
    pool.step()
    runner.finish(ids[0])
    pool.run(lambda: True)
    assert store.get(ids[0]).state is JobState.DONE and result(tmp_path, ids[0]) == "made"
    assert (store.get(ids[1]).state, store.get(ids[1]).attempts) == (JobState.QUEUED, 0)
    assert list((tmp_path / "results" / RUNNING).iterdir()) == []


def test_pool_retries_after_database_failure(store, runner, new_pool, monkeypatch):
    submitted(store)
    pool: JobPool = new_pool()
    monkeypatch.setattr("services.jobs.pool.AGAIN_S", 0.0)
    looks, step = [], pool.step

    def sometimes():
        looks.append(1)
        if len(looks) == 1:
            raise StoreUnavailable("the database does not answer")
        step()

    pool.step = sometimes
    pool.run(lambda: bool(runner.tasks))
    assert len(looks) == 2


def test_pool_raises_if_database_fails_longer_than_patience(store, runner, new_pool, monkeypatch):
    submitted(store)
    pool: JobPool = new_pool()
    monkeypatch.setattr("services.jobs.pool.AGAIN_S", 0.0)

    def never():
        raise StoreUnavailable("its disk is full; free space")

    pool.step = never
    with pytest.raises(StoreUnavailable, match="disk is full"):
        pool.run(lambda: False, patience_s=0.1)


@pytest.mark.parametrize("file", ["report.json", "model.isplat"])
def test_results_remove_deletes_result_and_may_be_repeated(new_pool, tmp_path, file):
    pool = new_pool()
    (tmp_path / "results" / "one").mkdir()
    (tmp_path / "results" / "one" / file).write_text("{}")
    assert pool._results.files("one") == [file]
    pool._results.remove("one")
    pool._results.remove("one")
    assert not (tmp_path / "results" / "one").exists()
