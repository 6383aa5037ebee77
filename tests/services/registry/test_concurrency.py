"""Concurrent threads and processes on one registry: one change succeeds, others conflict, numbers are unique."""

import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from services.errors import NotFound
from services.registry.models import ModelRegistry
from tests.services.registry.activating import ROUNDS, activate_together
from tests.services.registry.made import add_ready, assert_whole, packed_model
from tests.services.registry.stub_check import says


@pytest.mark.slow
def test_concurrent_activations_in_two_processes_succeed_once(new_registry, files, database_url, tmp_path):
    registry = new_registry()
    for seed in range(3):
        add_ready(registry, files, seed)
    registry.activate("liver", 1, None, "admin")
    context = multiprocessing.get_context("spawn")
    gate, results = context.Barrier(3), context.Queue()
    processes = [
        context.Process(target=activate_together, args=(tmp_path / "registry", database_url, version, gate, results))
        for version in (2, 3)
    ]
    for process in processes:
        process.start()
    try:
        for _ in range(ROUNDS):
            gate.wait(300)
            said = [results.get(timeout=300), results.get(timeout=300)]
            (won,) = [each for each in said if isinstance(each, int)]
            (lost,) = [each for each in said if isinstance(each, str)]
            assert (
                lost == f"model 'liver' has version {won} active, not version 1 as expected; look again and decide anew"
            )
            assert registry.active("liver").version == won
            assert_whole(registry)
            registry.rollback("liver", "admin", expected_current=won)
            gate.wait(300)
    finally:
        for process in processes:
            process.join(300)
            process.close()
        results.close()
        results.join_thread()


def test_concurrent_uploads_get_different_version_numbers(registry, files):
    file = packed_model(files)
    with ThreadPoolExecutor(4) as pool:
        records = list(pool.map(lambda _: registry.upload("liver", file, None, "surgeon"), range(12)))
    assert sorted(record.version for record in records) == list(range(1, 13))
    assert_whole(registry)


def test_concurrent_checks_of_same_version_agree(registry, files):
    version = registry.upload("liver", packed_model(files), None, "surgeon").version
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: registry.check("liver", version), range(2))
    assert first == second and first.state == "ready"


@pytest.mark.slow
def test_checks_run_one_at_a_time(tmp_path, files):
    """Each check creates a folder exclusively and fails if another check holds it."""
    taken = str(tmp_path / "taken")
    program = says(
        f'import os, time; os.mkdir({taken!r}); time.sleep(0.2); os.rmdir({taken!r}); print(\'{{"stage": "ready"}}\')'
    )
    with ModelRegistry(tmp_path / "registry", check_program=program) as registry:
        for _ in range(3):
            registry.upload("liver", packed_model(files), None, "surgeon")
        with ThreadPoolExecutor(3) as pool:
            assert {
                record.state for record in pool.map(lambda version: registry.check("liver", version), (1, 2, 3))
            } == {"ready"}


@pytest.mark.slow
def test_readers_see_active_version_during_activations_and_rollbacks(registry, files):
    """Activations and rollbacks run concurrently with the readers."""
    for seed in range(2):
        add_ready(registry, files, seed)
    registry.activate("liver", 1, None, "admin")
    over = threading.Event()

    def swap():
        for _ in range(20):
            registry.activate("liver", 2, 1, "admin")
            registry.rollback("liver", "admin")
        over.set()

    with ThreadPoolExecutor(1) as pool:
        swapping = pool.submit(swap)
        seen = set()
        while not over.is_set() and not swapping.done():
            seen.add(registry.active("liver").version)
        swapping.result()
    assert seen <= {1, 2} and seen
    assert_whole(registry)


def test_check_raises_not_found_if_version_is_deleted_meanwhile(new_registry, files):
    registry = new_registry()
    version = registry.upload("liver", packed_model(files), None, "surgeon").version
    registry._reached = lambda step: registry.delete("liver", version, "admin") if step == "check ended" else None
    with pytest.raises(NotFound, match="'liver' has no version 1"):
        registry.check("liver", version)
    assert registry.versions("liver") == []
