from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys

from services.bus.runtime import ProcessIdentity

SLEEP = [sys.executable, "-c", "import time; time.sleep(60)"]


def test_process_identity_compares_pid_and_start_time():
    me = ProcessIdentity.of(os.getpid())
    assert me is not None and me.is_alive
    assert not ProcessIdentity(me.pid, "another boot 1").is_alive


def test_zombie_process_is_not_alive():
    process = subprocess.Popen(SLEEP)
    identity = ProcessIdentity.of(process.pid)
    assert identity is not None and identity.is_alive
    assert identity.signal(signal.SIGKILL)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it is a zombie now
    assert not identity.is_alive
    assert not identity.signal(signal.SIGKILL)
    process.wait()
    assert ProcessIdentity.of(process.pid) is None


def test_signal_is_not_sent_to_other_process_with_same_pid():
    with subprocess.Popen(SLEEP) as process:
        assert not ProcessIdentity(process.pid, "another boot 1").signal(signal.SIGKILL)
        assert process.poll() is None
        process.kill()


def test_ended_waits_for_end_of_process():
    async def run() -> None:
        process = subprocess.Popen(SLEEP)
        identity = ProcessIdentity.of(process.pid)
        assert identity is not None
        assert not await identity.ended(0.05)
        waiting = asyncio.create_task(identity.ended())
        await asyncio.sleep(0.01)
        process.kill()
        assert await waiting
        process.wait()
        assert await identity.ended()

    asyncio.run(run())
