"""Schema history of the jobs (Alembic)."""
