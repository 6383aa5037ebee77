"""Pictures and videos of registry models, rendered by the export program. This module does not import torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.exports.formats import ExportFormat
from gsplat_core.value_ranges import check_seen_at
from operators.settings import RenderOptions

PictureView = Literal["recorded", "orbit", "stereo"]
PICTURES: Mapping[str, ExportFormat] = {
    each.name: each for each in (ExportFormat("png", ".png", "image/png"), ExportFormat("mp4", ".mp4", "video/mp4"))
}
"""Formats of renderings: a picture at one time, and a video over the model's time window."""


@dataclass(frozen=True)
class RenderWish:
    """Rendering of a model that a client requests: format, viewpoint and size.

    Raises:
        InvalidSetting: if the fields do not fit together.
    """

    format: ExportFormat
    options: RenderOptions
    view: PictureView = "recorded"
    time_s: float | None = None
    """Time of a picture in seconds; None selects the end of the model's window."""

    def __post_init__(self) -> None:
        if self.view not in get_args(PictureView):
            raise InvalidSetting(f"view is {self.view!r:.60}; choose {', '.join(get_args(PictureView))}")
        if self.format.name != "png" and self.time_s is not None:
            raise InvalidSetting("a video shows the whole time window of the model; leave the time out, or take png")

    def times_in(self, window_s: tuple[float, float]) -> list[float]:
        """Return the time of a picture, or the ends of a video.

        Raises:
            InvalidSetting: if the requested time is outside the window.
        """
        if self.format.name != "png":
            return list(window_s)
        time_s = window_s[1] if self.time_s is None else self.time_s
        check_seen_at(time_s, window_s)
        return [time_s]
