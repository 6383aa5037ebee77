"""Replays as jobs: kept in the database, claimed with a lease, run by a bounded pool or on Ray, each result published once."""
