"""Replay options that a caller may choose, named as in `intrasplat replay`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from gsplat_core.geometry.registry import DEPTHS, WITH_ADDRESS

DEPTH_CHOICES = ("auto", *(WITH_ADDRESS.get(name, name) for name in DEPTHS))


class ReplayOptions(BaseModel):
    """Replay options. Omitted options have the defaults of `intrasplat replay`."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    device: Literal["cpu", "cuda"] = Field(default="cpu", description="Where it is computed.")
    field: Literal["auto", "basis", "hexplane"] = Field(default="auto", description="Deformation field.")
    renderer: Literal["alpha"] = Field(default="alpha", description="How Gaussians become a picture.")
    seed: int = Field(default=0, ge=0, le=2**31 - 1, description="The same seed gives the same bytes.")
    steps_per_frame: int | None = Field(
        default=None, ge=1, le=10_000, description="Optimiser steps per frame; null: the field's."
    )
    max_frames: int | None = Field(default=None, ge=1, le=10_000_000, description="Stop after this many frames.")
    scale: float = Field(default=1.0, gt=0, le=4, allow_inf_nan=False, description="Resize the frames by this factor.")
    depth: str = Field(
        default="auto",
        max_length=1000,
        description=f"Where the frames' depth comes from: {', '.join(DEPTH_CHOICES)}.",
        json_schema_extra={"examples": ["auto", "parallax"]},
    )
    poses: Literal["given", "estimated"] = Field(
        default="given", description="Where the scope was: as the recording says, or estimated from the pictures."
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

    @field_validator("depth")
    @classmethod
    def _registered(cls, choice: str) -> str:
        name, colon, address = choice.partition(":")
        if choice == "auto" or (name in DEPTHS and (bool(colon and address) if name in WITH_ADDRESS else not colon)):
            return choice
        raise ValueError(f"there is no depth {choice!r:.60}; choose {', '.join(DEPTH_CHOICES)}")

    def chosen(self) -> dict[str, Any]:
        """Return the options that differ from the defaults, as stored with the job."""
        return self.model_dump(exclude_defaults=True)


class RemoteReplayOptions(ReplayOptions):
    """Replay options for API callers, without options that name files on the server."""

    @field_validator("depth")
    @classmethod
    def _names_no_file(cls, choice: str) -> str:
        name = choice.partition(":")[0]
        if name in WITH_ADDRESS:
            raise ValueError(
                f"{WITH_ADDRESS[name]} names a file of the server, which callers may not choose; replay the recording on that machine with"
                " `intrasplat replay` or `intrasplat batch`"
            )
        return choice
