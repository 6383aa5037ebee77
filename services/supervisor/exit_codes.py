"""Exit codes of capture and engine processes."""

FINISHED = 0
FAILED = 1
NO_USE = 2
"""The request cannot be fulfilled; a restart would fail in the same way."""
