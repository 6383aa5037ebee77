"""The first Ctrl-C asks, the second insists, and afterwards the handlers are as they were."""

from __future__ import annotations

import os
import signal

import pytest

from services.cli.terminal import InterruptRequest


def test_the_first_signal_asks_and_the_second_raises():
    before = signal.getsignal(signal.SIGINT)
    with InterruptRequest() as interrupt:
        assert not interrupt()
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_sigterm_asks_too():
    with InterruptRequest() as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt()
