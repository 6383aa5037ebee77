"""Where the depth of frames comes from, by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from gsplat_core.errors import InvalidSetting
from gsplat_core.geometry.depth_map import DepthMap
from gsplat_core.geometry.measured_depth import measured_confidence
from gsplat_core.registry import Registry
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DepthOrigin, Frame, FrameStatus


class Estimator(Protocol):
    """Finds the depth of one frame after another of one stream, in order; it may remember what it has seen. The same frames give the same bytes."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """The frame's depth, seen from `camera` (with the frame's pose, where that is known); None: there is nothing in it to find depth from.

        A frame with `new_scene` has nothing to do with those before it.
        """
        ...


@runtime_checkable
class OnDevice(Protocol):
    """An estimator that need not work on the CPU."""

    def work_on(self, device: str) -> None:
        """From now on work on this device, beside what else goes on there."""
        ...


class RecordedDepth:
    """The depth that a frame came with. Where no confidence came with it, single pixels are doubted (`measured_confidence`)."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`."""
        if frame.depth is None:
            return None
        confidence = frame.depth_confidence
        if confidence is None:
            confidence = measured_confidence(frame.depth)
        return DepthMap(frame.depth, confidence, frame.depth_origin or DepthOrigin.MEASURED, frame.depth_is_metric)


class NoDepth:
    """None, whatever a frame came with."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """See `Estimator`."""
        return None


DEPTHS: Registry[Callable[..., Estimator]] = Registry(
    "depth",
    {
        "recorded": RecordedDepth,
        "stereo": "gsplat_core.geometry.stereo:StereoDepth",
        "light": "gsplat_core.geometry.light:LightDepth",
        "parallax": "gsplat_core.geometry.key_frames:ParallaxDepth",
        "onnx": "gsplat_core.geometry.learned:LearnedDepth",
        "none": NoDepth,
    },
)
"""Estimators by name: what makes one for a stream, from an address if its name is in `WITH_ADDRESS`."""
WITH_ADDRESS = {"onnx": "onnx:FILE"}
"""Whose name is followed by a colon and an address, and how that looks."""


def _always(frame: Frame) -> bool:
    return True


def _has_calibrated_eyes(frame: Frame) -> bool:
    return frame.right_camera is not None


def _has_pose(frame: Frame) -> bool:
    return frame.pose is not None


AUTO: dict[str, Callable[[Frame], bool]] = {"recorded": _always, "stereo": _has_calibrated_eyes}
"""What `auto` asks, in this order and for such frames, until one of them answers ..."""
AUTO_WITH_TIME: dict[str, Callable[[Frame], bool]] = {**AUTO, "parallax": _has_pose}
"""... and where no camera has to be kept up with."""


def check_depth(choice: str) -> None:
    """Raises InvalidSetting for what is neither `auto` nor in `DEPTHS`, and as what makes an estimator from an address."""
    name, colon, address = choice.partition(":")
    if name in WITH_ADDRESS and not address:
        raise InvalidSetting(f"depth is {choice!r}; it needs an address: {WITH_ADDRESS[name]}")
    if choice != "auto" and (name not in DEPTHS or (colon and name not in WITH_ADDRESS)):
        names = (WITH_ADDRESS.get(each, each) for each in DEPTHS)
        raise InvalidSetting(f"depth is {choice!r}; choose auto, {', '.join(names)}")
    if name in WITH_ADDRESS:
        new_estimator(choice)


def depth_inputs(choice: str) -> tuple[Path, ...]:
    """Return the files that a depth source reads: those of a name in `WITH_ADDRESS`."""
    name, _, address = choice.partition(":")
    path = address.partition("?")[0]
    return (Path(path),) if name in WITH_ADDRESS and path else ()


def new_estimator(choice: str) -> Estimator:
    """The estimator that `choice` names, for one stream. Raises as `check_depth`."""
    name, _, address = choice.partition(":")
    return DEPTHS[name](address) if name in WITH_ADDRESS else DEPTHS[name]()


class Sentences:
    """Sentences that were said of frames, each kind once: what is the same up to the first colon differs in its numbers alone."""

    def __init__(self) -> None:
        self._first: dict[str, str] = {}
        self._frames: Counter[str] = Counter()

    def add(self, sentence: str | None) -> None:
        """Take what was said of one frame; None: nothing."""
        if sentence is not None:
            kind = sentence.partition(":")[0]
            self._first.setdefault(kind, sentence)
            self._frames[kind] += 1

    def counted(self) -> dict[str, int]:
        """The first sentence of each kind, and of how many frames it was said, or one like it."""
        return {self._first[kind]: frames for kind, frames in sorted(self._frames.items())}


class DepthFinder:
    """Gives the frames of one stream the depth that a setting asks for."""

    def __init__(self, choice: str, camera: Camera, *, has_time: bool = False, device: str = "cpu") -> None:
        """choice: `auto` or as `new_estimator` takes it. camera: that of the frames. has_time: what takes long may be asked by `auto`, too. device: where
        an estimator works that need not work on the CPU.

        Raises as `check_depth`.
        """
        check_depth(choice)
        self._camera = camera
        auto = AUTO_WITH_TIME if has_time else AUTO
        asked = auto if choice == "auto" else {choice: _always}
        self._asked = [(new_estimator(name), suits) for name, suits in asked.items()]
        for estimator, _ in self._asked:
            if isinstance(estimator, OnDevice):
                estimator.work_on(device)
        self.doubts, self.remarks = Sentences(), Sentences()
        """What spoke against a frame's depth as a whole, and what else was said about it."""

    def seeks_in(self, frame: Frame) -> bool:
        """Whether there is anything to look for in a frame, beside the depth that it came with."""
        return any(
            suits(frame) for estimator, suits in self._asked if not isinstance(estimator, RecordedDepth | NoDepth)
        )

    def find(self, frame: Frame, *, shown_only: bool = False) -> DepthMap | None:
        """The first answer that is not doubted; None where there is none. shown_only: nothing is learned from the frame, nor about later ones."""
        camera = self._camera if frame.pose is None else self._camera.with_pose(frame.pose)
        if (camera.width_px, camera.height_px) != (frame.width_px, frame.height_px):  # a stream may change its size
            camera = camera.resized(frame.width_px, frame.height_px)
        # What is not learned from needs no depth; what it came with costs nothing.
        shown_only = shown_only or frame.status is FrameStatus.DAMAGED or frame.withheld is not None
        for estimator, suits in self._asked:
            if not suits(frame) or (shown_only and not isinstance(estimator, RecordedDepth)):
                continue
            found = estimator.estimate(frame, camera)
            if found is None:
                continue
            self.remarks.add(found.remark)
            self.doubts.add(found.doubt)
            if found.doubt is None:
                return found
        return None

    def with_depth(self, frame: Frame, *, shown_only: bool = False) -> Frame:
        """The frame with what was found, and without the depth that it came with where that is not it."""
        found = self.find(frame, shown_only=shown_only)
        if found is None:
            return frame.with_fields(depth=None, depth_confidence=None, depth_origin=None)
        if found.depth is frame.depth:
            # What is believed wherever it is known needs no second plane.
            doubts = bool(np.any((found.confidence == 0) & (frame.depth > 0)))
            return frame.with_fields(depth_confidence=found.confidence) if doubts else frame
        return frame.with_fields(depth=found.kept, depth_confidence=found.confidence, depth_origin=found.origin)
