"""Main picture output of an engine, published with its metadata."""

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
from services.bus.messages import Durations
from services.bus.pictures import PicturePublisher

Shows = Literal["live", "model"]
SCORES = ("psnr_db", "previous_frame_db", "next_frame_db")
"""Score names. Tissue PSNR of the last scored frame: of the displayed picture (a training error),
of the previous raw frame as a baseline, and of the newest predicted frame before training on it."""


class Screen:
    """Single publisher of an engine's pictures, so each picture is rendered from one model.

    The screen shows the live reconstruction or a finished model. On a switch, the old pictures
    continue until the first picture of the new kind.
    """

    def __init__(self, publisher: PicturePublisher) -> None:
        self._publisher = publisher
        self._lock = threading.Lock()
        self._wanted: Shows = "live"
        self._shown: Shows = "live"
        self.pictures = 0
        """Number of new pictures."""
        self.published = 0
        """Number of publications, including repeats of a picture with another state or age."""
        self.ages = Durations()
        """Ages of new pictures at publication."""
        self._last: dict[str, Any] = {}
        self._scores: dict[str, float | None] = dict.fromkeys(SCORES)

    @property
    def wanted(self) -> Shows:
        """Return the requested kind of picture."""
        return self._wanted

    def want(self, shows: Shows) -> None:
        """Switch to a kind of picture; takes effect with its next picture."""
        with self._lock:
            self._wanted = shows

    def show(self, shown: ShownPicture) -> bool:
        """Publish a picture of the live reconstruction.

        Returns:
            False if it was not published.
        """
        return self.publish("live", {**header_of(shown), **self._scores}, shown.image)

    def scored(self, scored: ScoredFrame) -> None:
        """Store the scores of the newest scored frame for the following picture headers."""
        found = {
            "psnr_db": scored.quality.psnr_tissue_db,
            "previous_frame_db": scored.previous_frame_db,
            "next_frame_db": scored.next_frame_db,
        }
        known = {name: round(value, 3) if math.isfinite(value) else None for name, value in found.items()}
        # Only some frames are predicted, so the last prediction score is kept until the next one.
        if known["next_frame_db"] is None:
            known["next_frame_db"] = self._scores["next_frame_db"]
        self._scores = known

    def publish(self, shows: Shows, header: Mapping[str, Any], image: NDArray[np.uint8]) -> bool:
        """Publish a picture.

        Args:
            shows: kind of the picture.
            header: metadata of the picture.
            image: RGB uint8 [H, W, 3].

        Returns:
            False if the other kind is already displayed; nothing is published then.
        """
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
        """Return picture counts and the last header for the heartbeats."""
        with self._lock:
            return {"pictures": self.pictures, "published": self.published, "picture": dict(self._last)}


def header_of(shown: ShownPicture) -> dict[str, Any]:
    """Return the header of a live picture (docs/design/processes.md)."""
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
