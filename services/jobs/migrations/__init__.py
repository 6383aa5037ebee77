"""The history of the jobs' schema (Alembic)."""
