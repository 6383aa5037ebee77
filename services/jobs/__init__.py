"""Replay jobs: stored in the database, claimed with a lease, run by a process pool or on Ray, each
result published once."""
