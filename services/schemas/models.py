"""Records of models and their versions in the API."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from operators.settings import CallerRenderOptions
from services.exports.renderings import PICTURES, RenderWish


class VersionView(BaseModel):
    """Model version. `state`: uploaded, validated, ready, active, retired, or rejected with a reason."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    version: int = Field(examples=[3])
    state: str = Field(examples=["ready"])
    reason: str | None = None
    digest: str = Field(description="SHA-256 of the uploaded file; of a splat file, that of the model made from it.")
    size_bytes: int
    uploaded_at: datetime | str
    uploaded_by: str
    description: dict[str, Any] = Field(
        {},
        examples=[{"gaussians": 20480, "field": None, "renderer": "alpha"}],
        description="Results of the check: Gaussians, deformation field (null for a static model), renderer that trained the"
        " model, picture size, time window.",
    )


class ModelView(BaseModel):
    """Model and its active version."""

    model_config = ConfigDict(from_attributes=True)
    name: str = Field(examples=["liver"])
    active: int | None = Field(examples=[3])


class RenderRequest(BaseModel):
    """Rendering of a model: a picture at one time, or a video over its time window."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"examples": [{"format": "png", "options": {"outputs": ["image", "normals"]}}]},
    )
    format: Literal["png", "mp4"] = "png"
    view: Literal["recorded", "orbit", "stereo"] = Field(
        "recorded", description="Camera: the model's own, an orbit, or a stereo pair side by side."
    )
    time_s: FiniteFloat | None = Field(
        None,
        strict=True,
        ge=-1e9,
        le=1e9,
        description="Time of a picture within the model's time window, in seconds. Default: the end of the window.",
        examples=[0.5],
    )
    options: CallerRenderOptions = CallerRenderOptions()

    @model_validator(mode="after")
    def _picture_or_video(self) -> RenderRequest:
        self.wish()
        return self

    def wish(self) -> RenderWish:
        """Return the request for the export program."""
        return RenderWish(PICTURES[self.format], self.options, self.view, self.time_s)


class Activation(BaseModel):
    """Version to activate, and the version that the caller expects to be active. A different active
    version refuses the request."""

    model_config = ConfigDict(extra="forbid", strict=True)
    version: int = Field(ge=1, le=2**31 - 1, examples=[3])
    expected_current: int | None = Field(
        ge=1, le=2**31 - 1, examples=[2], description="Version that the caller expects to be active; null: none."
    )
