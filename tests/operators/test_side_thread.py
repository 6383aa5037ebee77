"""Background threads use only the resources that the graph leaves."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from gsplat_core.machine import NICENESS, step_back, usable_cores


def in_a_thread(work):
    """Return the result of `work` run in another thread."""
    answers = []
    thread = threading.Thread(target=lambda: answers.append(work()))
    thread.start()
    thread.join()
    return answers[0]


@pytest.mark.skipif(sys.platform != "linux", reason="priorities of threads are those of Linux")
def test_step_back_changes_niceness_of_own_thread_only():
    def stepped():
        step_back()
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    before = os.getpriority(os.PRIO_PROCESS, 0)
    assert in_a_thread(stepped) == NICENESS
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_usable_cores_is_between_one_and_cpu_count():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)
