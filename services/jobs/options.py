"""Options of a replay that a caller may choose: those of `intrasplat replay`, by the same names."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class ReplayOptions(BaseModel):
    """How a recording is replayed; what is left out is as `intrasplat replay` has it."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: Literal["cpu", "cuda"] = Field(default="cpu", description="Where it is computed.")
    field: Literal["auto", "basis", "hexplane"] = Field(default="auto", description="Deformation field.")
    renderer: Literal["alpha"] = Field(default="alpha", description="How Gaussians become a picture.")
    seed: int = Field(default=0, ge=0, le=2**31 - 1, description="The same seed gives the same bytes.")
    steps_per_frame: int | None = Field(
        default=None, ge=1, le=10_000, description="Optimiser steps per frame; null: the field's."
    )
    max_frames: int | None = Field(default=None, ge=1, le=10_000_000, description="Stop after this many frames.")
    scale: float = Field(default=1.0, gt=0, le=4, allow_inf_nan=False, description="Resize the frames by this factor.")
    depth: Literal["auto", "recorded", "stereo", "none"] = Field(
        default="auto", description="Where the frames' depth comes from; `stereo`: from the two eyes."
    )
    eyes: Literal["left", "both"] | None = Field(
        default=None, description="Pictures of a stereo scope that are trained on; null: the left ones."
    )
    heldout: bool = Field(
        default=False, description="Show every eighth frame without training on it, and score it apart."
    )
    ignore_schedule: bool = Field(
        default=False, description="Replay a recorded session like any recording, without the steps that it made."
    )

    def chosen(self) -> dict[str, Any]:
        """Those that differ from the defaults: what is kept with the job."""
        return self.model_dump(exclude_defaults=True)
