"""Job attempts on a local Ray: run, killed, cancelled, published once."""

from __future__ import annotations

import json
import time

import pytest

from services.errors import StoreUnavailable
from services.jobs.pool import JobPool, PoolSettings
from services.jobs.results import RUNNING, Results
from services.jobs.store import JobState, NewJob

pytestmark = pytest.mark.slow

WITHIN_S = 300.0


@pytest.fixture
def on_ray():
    """A local Ray. Its 30 s start limit is too short on a busy machine, so the start is retried."""
    ray = pytest.importorskip("ray", reason="Ray is not installed (extra `ray`)")  # takes seconds

    from services.jobs.runners import OnRay

    for last in (False, False, False, True):
        try:
            return OnRay("local")
        except Exception:
            ray.shutdown()
            if last:
                raise


@pytest.mark.filterwarnings("ignore")  # of Ray's own
def test_pool_on_local_ray_finishes_fails_and_cancels_jobs(store, recording, tmp_path, on_ray):
    (good,) = store.submit([NewJob("a", str(recording))], {"steps_per_frame": 2}, "operator").ids
    (missing,) = store.submit([NewJob("c", str(tmp_path / "nothing"))], {}, "operator").ids
    (long,) = store.submit([NewJob("d", str(recording))], {"steps_per_frame": 10_000}, "operator").ids
    pool = JobPool(store.database, Results(tmp_path / "results"), on_ray, PoolSettings(workers=1, pack_models=True))
    end_s = time.monotonic() + WITHIN_S

    def is_over():
        assert time.monotonic() < end_s, store.counts()
        if store.get(long).state is JobState.RUNNING:
            store.cancel(long, "nurse")
        return not any(job.is_open for job in store.newest())

    pool.run(is_over)
    assert [store.get(job_id).state for job_id in (good, missing, long)] == [
        JobState.DONE,
        JobState.FAILED,
        JobState.CANCELLED,
    ]
    assert "no such file" in store.get(missing).reason
    report = json.loads((tmp_path / "results" / good / "report.json").read_text())
    assert report["frames"]["displayed"] == 3
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == sorted([good, RUNNING])
    assert (tmp_path / "results" / good / "model.isplat").is_file()


@pytest.mark.parametrize("address", ["no address", "scheme://x"])
@pytest.mark.filterwarnings("ignore")
def test_on_ray_raises_for_unusable_address(address):
    from services.jobs.runners import OnRay

    with pytest.raises(StoreUnavailable, match=r"Ray at .* cannot be used"):
        OnRay(address)
