"""What an engine shows, published with what is known about it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from operators.messages import ShownPicture
from operators.metrics import ScoredFrame
from services.bus.durations import Durations
from services.bus.pictures import PicturePublisher

Shows = Literal["live", "model"]


class Screen:
    """The one place from which an engine's pictures go out, so that each is of one model as a whole.

    It shows the live reconstruction or a finished model. From one to the other there is no moment without pictures: what was shown goes on
    until the first picture of the other is there.
    """

    def __init__(self, publisher: PicturePublisher) -> None:
        self._publisher = publisher
        self._lock = threading.Lock()
        self._wanted: Shows = "live"
        self._shown: Shows = "live"
        self.pictures = 0
        """New pictures that were shown."""
        self.published = 0
        """With those that were shown again, with another state or age."""
        self.ages = Durations()
        """Of new pictures, when they were shown."""
        self._last: dict[str, Any] = {}
        self._psnr_db: float | None = None

    @property
    def wanted(self) -> Shows:
        """What is to be shown."""
        return self._wanted

    def want(self, shows: Shows) -> None:
        """Show the one or the other from its next picture on."""
        with self._lock:
            self._wanted = shows

    def show(self, shown: ShownPicture) -> bool:
        """A picture of the live reconstruction; False when it is not shown."""
        return self.publish("live", {**header_of(shown), "psnr_db": self._psnr_db}, shown.image)

    def scored(self, scored: ScoredFrame) -> None:
        """What the newest scored picture's tissue PSNR was: the next ones tell it."""
        value = scored.quality.psnr_tissue_db
        self._psnr_db = round(value, 3) if math.isfinite(value) else None

    def publish(self, shows: Shows, header: Mapping[str, Any], image: NDArray[np.uint8]) -> bool:
        """Publish a picture; False, without effect, when the other one is shown by now."""
        with self._lock:
            if shows != self._wanted and self._shown != shows:
                return False
            self._shown = shows
            self._publisher.publish({"show": shows, **header}, image)
            self.published += 1
            if header["new"]:
                self.pictures += 1
                self.ages.add(header["age_ms"] * 1e-3)
            self._last = {name: header[name] for name in ("state", "age_ms", "model_version", "psnr_db")}
            self._last |= {"show": shows, "shown_ns": time.monotonic_ns()}
            return True

    def figures(self) -> dict[str, Any]:
        """For the heartbeats."""
        with self._lock:
            return {"pictures": self.pictures, "published": self.published, "picture": dict(self._last)}


def header_of(shown: ShownPicture) -> dict[str, Any]:
    """What is said of a picture of the live reconstruction (docs/processes.md)."""
    rendered = shown.rendered
    content = rendered.content or rendered.frame
    pose = rendered.frame.pose
    return {
        **({} if pose is None else {"world_to_camera": pose.tolist()}),
        "seq": rendered.frame.seq,
        "pts_ns": rendered.frame.pts_ns,
        "arrived_ns": content.arrived_ns,
        "shown_ns": shown.shown_ns,
        "age_ms": round(shown.age_ns * 1e-6, 3),
        "state": shown.state.value,
        "new": shown.new,
        "model_version": rendered.model_version,
        "steps": rendered.steps,
    }
