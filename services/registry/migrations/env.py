"""Alembic environment. Runs migrations on the connection and in the transaction of `Database.migrate`."""

from __future__ import annotations

from alembic import context

from services.registry.records import METADATA

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=METADATA,
    version_table=context.config.attributes["version_table"],
    render_as_batch=True,
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
