"""Runs that exceed the memory are refused before any output, with the required and the available amount."""

from __future__ import annotations

import pytest

from operators.applications import limits
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings, replay
from operators.errors import MemoryTooSmall


@pytest.mark.parametrize("run", [replay, lambda settings: reconstruct(settings, 1)], ids=["replay", "reconstruct"])
def test_run_that_exceeds_memory_is_refused_before_output(tiny, tmp_path, monkeypatch, run):
    monkeypatch.setattr(limits, "available_bytes", lambda: 10 * 2**20)
    with pytest.raises(MemoryTooSmall, match=r"4 frames of tiny takes about .* MiB of memory, and 10\.0 MiB are free"):
        run(ReplaySettings(tiny, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_require_memory_accepts_any_size_if_free_memory_is_unknown(monkeypatch):
    monkeypatch.setattr(limits, "available_bytes", lambda: None)
    limits.require_memory(1 << 60, "it", "try")
