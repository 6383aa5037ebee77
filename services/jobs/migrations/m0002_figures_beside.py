"""Columns for the PSNR of the previous frame and of the next-frame prediction."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None
COLUMNS = ("previous_frame_db", "next_frame_db")


def upgrade() -> None:
    """Add these columns to the table `jobs`."""
    for name in COLUMNS:
        op.add_column("jobs", sa.Column(name, sa.Float, nullable=True))


def downgrade() -> None:
    """Remove these columns from the table `jobs`."""
    for name in reversed(COLUMNS):
        op.drop_column("jobs", name)
