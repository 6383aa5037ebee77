"""The first Ctrl-C requests a stop, the second raises, and signal handlers are restored."""

from __future__ import annotations

import os
import signal

import pytest

from services.cli.terminal import InterruptRequest


def test_interrupt_request_is_set_by_first_sigint_and_second_raises():
    before = signal.getsignal(signal.SIGINT)
    with InterruptRequest() as interrupt:
        assert not interrupt()
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupt_request_is_set_by_sigterm():
    with InterruptRequest() as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt()


def test_interrupt_request_restores_signal_handlers():
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


def test_interrupt_request_keeps_sighup_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with InterruptRequest() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupt()
    finally:
        signal.signal(signal.SIGHUP, before)
