"""The number of threads that one thread computes with."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest
import torch

from gsplat_core.machine import one_thread, use_one_thread


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def in_a_thread(work: Callable[[], int]) -> int:
    """Result of `work` in a new thread."""
    answers: list[int] = []
    thread = threading.Thread(target=lambda: answers.append(work()))
    thread.start()
    thread.join()
    return answers[0]


def test_use_one_thread_affects_calling_thread_only():
    def alone():
        use_one_thread()
        torch.ones(1_000_000).exp_()
        return torch.get_num_threads()

    assert in_a_thread(alone) == 1
    assert torch.get_num_threads() == 3 and in_a_thread(torch.get_num_threads) == 3


def test_one_thread_block_restores_previous_count():
    with one_thread():
        assert torch.get_num_threads() == 1 and in_a_thread(torch.get_num_threads) == 3
        with one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3 and in_a_thread(torch.get_num_threads) == 3


def test_one_thread_restores_count_after_error():
    @one_thread()
    def fail():
        assert torch.get_num_threads() == 1
        raise ValueError

    for _ in range(2):
        with pytest.raises(ValueError):
            fail()
        assert torch.get_num_threads() == 3


def test_one_thread_does_not_affect_other_threads():
    """LAPACK is tested too: the last bits of the solution of a large system depend on the number of threads."""
    matrix = torch.randn(400, 400, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    solved = lambda: torch.linalg.inv(matrix).sum(1)
    expected = solved()
    inside, leave = threading.Event(), threading.Event()

    def alone():
        with one_thread():
            inside.set()
            leave.wait()
        return torch.get_num_threads()

    answers: list[int] = []
    other = threading.Thread(target=lambda: answers.append(alone()))
    other.start()
    inside.wait()
    try:
        assert torch.equal(solved(), expected)
    finally:
        leave.set()
        other.join()
    assert answers == [3]
