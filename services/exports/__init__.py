"""Models and snapshots as files for other programs, created in a separate process within limits."""
