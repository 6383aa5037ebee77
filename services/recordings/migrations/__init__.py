"""The history of the recordings' schema (Alembic)."""
