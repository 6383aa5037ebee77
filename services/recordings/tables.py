"""Table of the recordings. Each change here needs a new file in `migrations/versions`."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa

from services.registry.database import Schema

METADATA = sa.MetaData(naming_convention={"pk": "pk_%(table_name)s"})
SCHEMA = Schema(Path(__file__).parent / "migrations", "alembic_version_recordings")

RECORDINGS = sa.Table(
    "recordings",
    METADATA,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("folder", sa.String(128), nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
    sa.Column("kept_bytes", sa.BigInteger, nullable=False),
    sa.Column("uploaded_by", sa.String(200), nullable=False),
    sa.Column("uploaded_at", sa.String(40), nullable=False),
    sa.Column("description", sa.JSON, nullable=False),
)
"""Recordings. `folder` is below the store's folder, `size_bytes` is the upload's size, `kept_bytes`
the current size."""
