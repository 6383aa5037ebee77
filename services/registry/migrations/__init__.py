"""Schema history of the registry (Alembic)."""
