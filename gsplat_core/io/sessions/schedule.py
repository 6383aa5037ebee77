"""What was trained in a live session, call by call, so that replay can make the same calls.

A `LiveReconstructor` gives the same models for the same calls, but live training is timed: how many steps a frame gets is known only
afterwards. The thread that owns the reconstructor writes a line for each call, in order:

    {"event":"reconstructor","device":"cpu","seed":0,"config":{…},"training":{…},"camera":{…}}   a new one is made
    {"event":"observe","seq":0,"steps":40,"train":true}      observe(frame 0) with so many steps, then publish(): what is shown of it
    {"event":"take_depth","seq":0,"origin":"stereo",…}       take_depth(frame 0 with the depth of these tracks): found after it was trained on
    {"event":"grow","seq":0}                                 grow(frame 0): Gaussians where it showed tissue that nothing covers
    {"event":"rehearse","steps":3}                           rehearse(3): further steps on earlier frames
    {"event":"begin_scene","seq":90}                         begin_scene(frame 90), which is observed next

A frame without an `observe` line came too late or had nothing to begin a scene with, and was passed over.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from gsplat_core.io.sessions.records import CameraRecord, Count, Origin, Record, Side, Text, Tracks

Steps = Annotated[int, Field(ge=0, le=10_000_000)]


class ReconstructorMade(Record):
    """A new reconstructor: at the beginning, and after an operator was restarted."""

    event: Literal["reconstructor"] = "reconstructor"
    device: Text
    seed: Count
    renderer: Text
    config: dict[str, Any]
    """The fields of `ReconstructorConfig`."""
    training: dict[str, Any]
    """The fields of `LiveTraining`."""
    camera: CameraRecord
    stereo: bool = False
    """Whether it was prepared for frames of two eyes."""


class SceneBegun(Record):
    """`LiveReconstructor.begin_scene` was called."""

    event: Literal["begin_scene"] = "begin_scene"
    seq: Count


class Observed(Record):
    """`LiveReconstructor.observe` and then `publish` were called."""

    event: Literal["observe"] = "observe"
    seq: Count
    steps: Steps
    train: bool


class DepthTaken(Record):
    """`LiveReconstructor.take_depth` was called with a frame that was observed before, and with depth that was found since."""

    event: Literal["take_depth"] = "take_depth"
    seq: Count
    origin: Origin
    width_px: Side
    height_px: Side
    tracks: Tracks
    """`depth`, and `depth_confidence` where there is any."""


class Grown(Record):
    """`LiveReconstructor.grow` was called with the frame that was observed last."""

    event: Literal["grow"] = "grow"
    seq: Count


class Rehearsed(Record):
    """`LiveReconstructor.rehearse` was called."""

    event: Literal["rehearse"] = "rehearse"
    steps: Steps


ScheduleLine = ReconstructorMade | SceneBegun | Observed | DepthTaken | Grown | Rehearsed
SCHEDULE_LINES = (ReconstructorMade, SceneBegun, Observed, DepthTaken, Grown, Rehearsed)
