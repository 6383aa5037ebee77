"""How a network wants its pictures and what its output means: stated in the model, or in a file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.files import read_regular

METADATA_KEY = "intrasplat"
"""Of the model's metadata: its value is a JSON object with the fields of the settings."""
MOST_BYTES = 1 << 16

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=16, le=4096)]
ClassIndex = Annotated[int, Field(ge=0, lt=4096)]


class PictureSettings(BaseModel):
    """What cannot be seen in a network's shapes, whatever it is for."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    white: Positive = 1.0
    """Value of a white pixel before `mean` is subtracted and `std` divided by: 1 or 255 mostly."""
    mean: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Per channel, red first."""
    std: tuple[Positive, Positive, Positive] = (1.0, 1.0, 1.0)
    channels: Literal["rgb", "bgr"] = "rgb"
    """Order in which the network takes them."""
    size: tuple[Side, Side] | None = None
    """Height and width in pixels of the pictures that it is given, where its input has no fixed size."""
    output: str | None = None
    """Name of the output; None: the first one."""
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    """Of the processor."""


class ToolSettings(PictureSettings):
    """The same of a network that finds tools."""

    values: Literal["auto", "logits", "probability"] = "auto"
    """Of an output with one channel. auto: probability where nothing outside of 0..1 comes out for three trial pictures."""
    tool_classes: Annotated[tuple[ClassIndex, ...], Field(min_length=1)] | None = None
    """Classes that are tools; None: all but 0. An output with one channel is class 1, and [0] makes it tissue's."""
    threshold: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """A pixel is tool where its probability, or that of the most likely tool class beside the most likely other one, is at least this.
    Below 0.5 fewer tools are missed and more tissue is lost."""


Settings = TypeVar("Settings", bound=PictureSettings)


def read_settings(path: Path, metadata: Mapping[str, str], kind: type[Settings]) -> Settings:
    """The settings of the network at `path`: those in `path` with `.json` added, else those in its metadata, else the defaults.

    Raises InvalidSetting for what is no such object.
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
