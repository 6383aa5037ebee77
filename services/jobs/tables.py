"""Tables of the jobs. Each change here needs a new file in `migrations/versions`."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sa

from services.registry.database import Schema

METADATA = sa.MetaData(
    naming_convention={
        "pk": "pk_%(table_name)s",
        "uq": "uq_%(table_name)s_%(column_0_name)s",
        "ix": "ix_%(column_0_label)s",
    }
)
SCHEMA = Schema(Path(__file__).parent / "migrations", "alembic_version_jobs")

JOBS = sa.Table(
    "jobs",
    METADATA,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("id", sa.String(32), nullable=False, unique=True),
    sa.Column("batch", sa.String(32), nullable=False, index=True),
    sa.Column("recording", sa.String(255), nullable=False),
    sa.Column("source", sa.Text, nullable=False),
    sa.Column("folder", sa.String(255), nullable=False, unique=True),
    sa.Column("options", sa.JSON, nullable=False),
    sa.Column("state", sa.String(16), nullable=False, index=True),
    sa.Column("reason", sa.Text, nullable=True),
    sa.Column("cancelled_by", sa.String(200), nullable=True),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("owner", sa.String(64), nullable=True),
    sa.Column("lease_until_ms", sa.BigInteger, nullable=True),
    sa.Column("frames_done", sa.Integer, nullable=False),
    sa.Column("frames", sa.Integer, nullable=True),
    sa.Column("psnr_db", sa.Float, nullable=True),
    sa.Column("previous_frame_db", sa.Float, nullable=True),
    sa.Column("next_frame_db", sa.Float, nullable=True),
    sa.Column("created_by", sa.String(200), nullable=False),
    sa.Column("created_at", sa.String(40), nullable=False),
    sa.Column("started_at", sa.String(40), nullable=True),
    sa.Column("ended_at", sa.String(40), nullable=True),
)
"""Jobs. `folder` is the unique result folder. `owner` is the pool that runs the job, until
`lease_until_ms` (wall clock). `cancelled_by` asks the owner to end the job."""

SUBMISSIONS = sa.Table(
    "submissions",
    METADATA,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("request", sa.String(64), nullable=False),
    sa.Column("batch", sa.String(32), nullable=False),
    sa.Column("created_at", sa.String(40), nullable=False),
)
"""Submissions by idempotency key (a digest with the caller), with the request digest and the
resulting batch."""
