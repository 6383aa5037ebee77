"""Schema history of the recordings (Alembic)."""
