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


def test_afterwards_signals_are_delivered_as_before():
    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    old = signal.set_wakeup_fd(sender)
    try:
        with InterruptRequest():
            assert all(signal.getsignal(number) != handler for number, handler in zip(numbers, before, strict=True))
        assert [signal.getsignal(number) for number in numbers] == before
        assert signal.set_wakeup_fd(old) == sender
    finally:
        signal.set_wakeup_fd(old)
        os.close(sender)
        os.close(receiver)


def test_a_hangup_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with InterruptRequest() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupt()
    finally:
        signal.signal(signal.SIGHUP, before)
