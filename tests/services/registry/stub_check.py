"""A check that takes no time; it loads nothing."""

from __future__ import annotations

import sys

_STEPS = '{"stage": "validated", "gaussians": 5}\n{"stage": "ready", "render_ms": 1.0}\n'
ALWAYS_READY = (sys.executable, "-S", "-c", f"import sys; sys.stdout.write({_STEPS!r})")
"""Replacement of the real check, which loads torch and takes seconds."""


def says(text: str) -> tuple[str, ...]:
    """A check that runs this Python."""
    return (sys.executable, "-S", "-c", text)
