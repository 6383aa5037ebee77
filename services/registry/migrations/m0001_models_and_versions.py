"""Initial tables of models, versions and activations."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the tables `models`, `versions` and `activations`."""
    op.create_table(
        "models",
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("created_at", sa.String(40), nullable=False),
        sa.Column("last_version", sa.Integer, nullable=False),
        sa.Column("active", sa.Integer, nullable=True),
        sa.PrimaryKeyConstraint("name", name="pk_models"),
    )
    op.create_table(
        "versions",
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("version", sa.Integer, nullable=False, autoincrement=False),
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
        sa.ForeignKeyConstraint(["name"], ["models.name"], name="fk_versions_name"),
        sa.PrimaryKeyConstraint("name", "version", name="pk_versions"),
    )
    op.create_table(
        "activations",
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("step", sa.Integer, nullable=False, autoincrement=False),
        sa.Column("version", sa.Integer, nullable=False),
        sa.ForeignKeyConstraint(["name"], ["models.name"], name="fk_activations_name"),
        sa.PrimaryKeyConstraint("name", "step", name="pk_activations"),
    )


def downgrade() -> None:
    """Drop the tables with all records of the registry."""
    for table in ("activations", "versions", "models"):
        op.drop_table(table)
