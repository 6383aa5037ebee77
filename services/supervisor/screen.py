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
SCORES = ("psnr_db", "previous_frame_db", "next_frame_db")
"""Tissue PSNR of the frame that was scored last: of the displayed picture (a training error), of the previous raw frame shown instead, and
of the newest predicted frame, before the model was trained on it."""


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
        self._scores: dict[str, float | None] = dict.fromkeys(SCORES)

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
        return self.publish("live", {**header_of(shown), **self._scores}, shown.image)

    def scored(self, scored: ScoredFrame) -> None:
        """Take the scores of the newest scored frame, which the headers of the following pictures state."""
        found = {
            "psnr_db": scored.quality.psnr_tissue_db,
            "previous_frame_db": scored.previous_frame_db,
            "next_frame_db": scored.next_frame_db,
        }
        known = {name: round(value, 3) if math.isfinite(value) else None for name, value in found.items()}
        # Only some frames are predicted: the last prediction's score stays until the next one.
        if known["next_frame_db"] is None:
            known["next_frame_db"] = self._scores["next_frame_db"]
        self._scores = known

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
            self._last = {name: header.get(name) for name in ("state", "age_ms", "model_version", *SCORES)}
            self._last |= {"show": shows, "shown_ns": time.monotonic_ns()}
            return True

    def figures(self) -> dict[str, Any]:
        """For the heartbeats."""
        with self._lock:
            return {"pictures": self.pictures, "published": self.published, "picture": dict(self._last)}


def header_of(shown: ShownPicture) -> dict[str, Any]:
    """What is said of a picture of the live reconstruction (docs/design/processes.md)."""
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
