"""Models and snapshots as files for other programs: made in a process of their own, kept within bounds."""
