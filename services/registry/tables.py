"""Tables of the registry. Each change here needs a new file in `migrations/versions`."""

from __future__ import annotations

import sqlalchemy as sa

METADATA = sa.MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "fk": "fk_%(table_name)s_%(column_0_name)s",
        "ix": "ix_%(table_name)s_%(column_0_name)s",
    }
)

MODELS = sa.Table(
    "models",
    METADATA,
    sa.Column("name", sa.String(64), primary_key=True),
    sa.Column("created_at", sa.String(40), nullable=False),
    sa.Column("last_version", sa.Integer, nullable=False),
    sa.Column("active", sa.Integer, nullable=True),
)
"""Models. `active` is the served version number; an activation updates only this row."""

VERSIONS = sa.Table(
    "versions",
    METADATA,
    sa.Column("name", sa.String(64), sa.ForeignKey("models.name"), primary_key=True),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
    sa.Column("manifest_sha256", sa.String(64), nullable=False),
    sa.Column("tensors_sha256", sa.String(64), nullable=False),
    sa.Column("blob", sa.String(128), nullable=False),
    sa.Column("uploaded_by", sa.String(200), nullable=False),
    sa.Column("uploaded_at", sa.String(40), nullable=False),
    sa.Column("changed_by", sa.String(200), nullable=False),
    sa.Column("changed_at", sa.String(40), nullable=False),
    sa.Column("description", sa.JSON, nullable=False),
)
"""Versions. Times are ISO 8601 in UTC. `blob` is the key of the uploaded file in the blob store."""

ACTIVATIONS = sa.Table(
    "activations",
    METADATA,
    sa.Column("name", sa.String(64), sa.ForeignKey("models.name"), primary_key=True),
    sa.Column("step", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("version", sa.Integer, nullable=False),
)
"""History of active versions, oldest first. An activation appends a row; a rollback deletes it."""
