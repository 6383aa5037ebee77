"""Input and output conventions of a network, from its metadata or a JSON file next to it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular

METADATA_KEY = "intrasplat"
"""Metadata key whose value is a JSON object with the fields of the settings."""
MOST_BYTES = 1 << 16

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=16, le=4096)]
ClassIndex = Annotated[int, Field(ge=0, lt=4096)]


class PictureSettings(BaseModel):
    """Settings of any picture network that its tensor shapes do not reveal."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    white: Positive = 1.0
    """Value of a white pixel before normalisation by `mean` and `std`, usually 1 or 255."""
    mean: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Mean per channel, red first."""
    std: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    channels: Literal["rgb", "bgr"] = "rgb"
    """Channel order of the network's input."""
    size: tuple[Side, Side] | None = None
    """Input height and width in pixels if the network has no fixed size."""
    output: str | None = None
    """Name of the output; None for the first one."""
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    """Number of CPU threads."""


class ToolSettings(PictureSettings):
    """Settings of a tool segmentation network."""

    values: Literal["auto", "logits", "probability"] = "auto"
    """Kind of a single-channel output. `auto` is probability if three trial pictures give no value
    outside 0..1.
    """
    tool_classes: Annotated[tuple[ClassIndex, ...], Field(min_length=1)] | None = None
    """Tool classes; None for all but 0. A single channel is the score of class 1; [0] declares it
    as tissue.
    """
    threshold: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """Probability from which a pixel is tool. With several classes it compares the most likely tool
    class with the most likely other class. Below 0.5 fewer tools are missed and more tissue is
    lost.
    """


Settings = TypeVar("Settings", bound=PictureSettings)


def read_settings(path: Path, metadata: Mapping[str, str], kind: type[Settings]) -> Settings:
    """Read the settings of the network at `path` from `path` + `.json`, else from its metadata,
    else return defaults.

    Raises:
        InvalidSetting: for unreadable or invalid settings.
    """
    beside = path.with_name(path.name + ".json")
    if beside.exists():
        try:
            text = read_regular(beside, MOST_BYTES)
        except OSError as error:
            raise InvalidSetting(f"{beside} cannot be read ({error.strerror or error})") from error
        where = str(beside)
    elif METADATA_KEY in metadata:
        text, where = metadata[METADATA_KEY].encode(), f"{path}: metadata {METADATA_KEY!r}"
    else:
        return kind()
    if len(text) > MOST_BYTES:
        raise InvalidSetting(f"{where} is larger than {MOST_BYTES >> 10} KiB; it should be a few lines")
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"]) or "the object"
        raise InvalidSetting(f"{where}: {place}: {first['msg']}") from error
