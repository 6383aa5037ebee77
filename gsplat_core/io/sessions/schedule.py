"""What was trained in a live session, call by call, so that replay can make the same calls.

A `Reconstructor` gives the same models for the same calls, but live training is timed: how many steps a frame gets is known only afterwards.
The thread that owns the reconstructor writes a line for each call, in order:

    {"event":"restart","why":"start","seq":0,"camera":{…},"settings":{…}}    a new reconstructor; the next observed frame starts its model
    {"event":"observe","seq":0,"steps":40,"train":true,"plans":[1,12,27]}    observe(frame): what `steps` and `plans` mean is below
    {"event":"publish","seq":0,"model_version":1}                            publish(); what is shown of frame 0 is rendered from it
    {"event":"rehearse","steps":3,"plans":[3]}                               further steps on the window while no new frame is there
    {"event":"skipped","seq":7,"why":"late"}                                 this frame came in and never reached the reconstructor

`steps` counts all optimiser steps of the call. A timed call draws the older frames that it trains on in batches, whose sizes it estimates
from the clock; `plans` are those sizes in order, and the last batch may have been cut short by the deadline.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from gsplat_core.io.sessions.records import CameraRecord, Count, Record, Text

Plans = Annotated[tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...], Field(max_length=100_000)]
Steps = Annotated[int, Field(ge=0, le=10_000_000)]


class Restarted(Record):
    """A new reconstructor was made: at the beginning, after a cut, when the size changed."""

    event: Literal["restart"] = "restart"
    why: Text
    seq: Count
    """The first frame that it is given."""
    camera: CameraRecord
    settings: dict[str, Any]
    """What it was made with, as JSON: the fields of `ReconstructorConfig`, `seed`, `device`."""


class Observed(Record):
    """`Reconstructor.observe` was called with a frame."""

    event: Literal["observe"] = "observe"
    seq: Count
    steps: Steps
    train: bool
    plans: Plans = ()


class Rehearsed(Record):
    """Further steps on the window were made."""

    event: Literal["rehearse"] = "rehearse"
    steps: Steps
    plans: Plans = ()


class Published(Record):
    """`Reconstructor.publish` was called."""

    event: Literal["publish"] = "publish"
    seq: Count
    """The frame that was observed last."""
    model_version: Count


class Skipped(Record):
    """A frame came in and never reached the reconstructor."""

    event: Literal["skipped"] = "skipped"
    seq: Count
    why: Text


ScheduleLine = Restarted | Observed | Rehearsed | Published | Skipped
SCHEDULE_LINES = (Restarted, Observed, Rehearsed, Published, Skipped)
