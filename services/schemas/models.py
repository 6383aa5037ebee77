"""Records of models and their versions in the API."""

from __future__ import annotations

from datetime import datetime

from pydantic import BaseModel, ConfigDict, Field


class VersionView(BaseModel):
    """Model version. `state`: uploaded, validated, ready, active, retired, or rejected with a reason."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    version: int = Field(examples=[3])
    state: str = Field(examples=["ready"])
    reason: str | None = None
    digest: str = Field(description="SHA-256 of the uploaded file.")
    size_bytes: int
    uploaded_at: datetime | str
    uploaded_by: str


class ModelView(BaseModel):
    """Model and its active version."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    active: int | None = Field(examples=[3])


class Activation(BaseModel):
    """Version to activate, and the version that the caller expects to be active. A different active
    version refuses the request."""

    model_config = ConfigDict(extra="forbid", strict=True)
    version: int = Field(ge=1, le=2**31 - 1, examples=[3])
    expected_current: int | None = Field(
        ge=1, le=2**31 - 1, examples=[2], description="Version that the caller expects to be active; null: none."
    )
