"""Creation of depth sources by name, and the selection of a source for each frame of a stream."""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsplat_core.choices import DEPTHS
from gsplat_core.choices import DEPTHS_WITH_ADDRESS as WITH_ADDRESS
from gsplat_core.depth.maps import DepthMap, Estimator, OfRecording, OnDevice, measured_confidence
from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus


class RecordedDepth(Estimator):
    """Depth that is part of the frame. Without a confidence in the frame, outlier pixels are
    rejected (`measured_confidence`).
    """

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Return the depth that is part of the frame, with its confidence; None without depth."""
        if frame.depth is None:
            return None
        confidence = frame.depth_confidence
        if confidence is None:
            confidence = measured_confidence(frame.depth)
        assert frame.depth_origin is not None
        return DepthMap(frame.depth, confidence, frame.depth_origin, frame.depth_is_metric)


class NoDepth(Estimator):
    """Depth source that ignores all depth, including the frame's own."""

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Return None, because all depth is ignored."""
        return None


def _always(frame: Frame) -> bool:
    return True


def _has_calibrated_eyes(frame: Frame) -> bool:
    return frame.right_camera is not None


def _has_pose(frame: Frame) -> bool:
    return frame.pose is not None


AUTO: dict[str, Callable[[Frame], bool]] = {"recorded": _always, "stereo": _has_calibrated_eyes}
"""Sources tried by `auto` in real-time use, in order, with the condition that a frame must meet."""
AUTO_WITH_TIME: dict[str, Callable[[Frame], bool]] = {**AUTO, "parallax": _has_pose}
"""Sources tried by `auto` without a real-time limit."""


def check_depth(choice: str) -> None:
    """Check the name of a depth source, and its address if the name has one.

    Raises:
        InvalidSetting: for an unknown name, a missing address, or an address that the estimator rejects.
    """
    name, colon, address = choice.partition(":")
    if name in WITH_ADDRESS and not address:
        raise InvalidSetting(f"depth is {choice!r}; it needs an address: {WITH_ADDRESS[name]}")
    if choice != "auto" and (name not in DEPTHS or (colon and name not in WITH_ADDRESS)):
        names = (WITH_ADDRESS.get(each, each) for each in DEPTHS)
        raise InvalidSetting(f"depth is {choice!r}; choose auto, {', '.join(names)}")
    if name in WITH_ADDRESS:
        new_estimator(choice)


def with_surface(frame: Frame, camera: Camera) -> Frame:
    """Return the frame with its depth smoothed by the `surface` function of the depth's origin, if there is one."""
    if frame.depth is None or frame.depth_origin is None or frame.depth_origin.surface is None:
        return frame
    module, function = frame.depth_origin.surface.split(":")
    smoothed: Frame = getattr(importlib.import_module(module), function)(frame, camera)
    return smoothed


def _kinds(choice: str) -> dict[str, type[Estimator]]:
    """Return the estimators that a setting may use, by name."""
    return {name: DEPTHS[name] for name in (AUTO_WITH_TIME if choice == "auto" else (choice.partition(":")[0],))}


def keeps_recorded(choice: str) -> bool:
    """Return True if a frame keeps its recorded depth with a setting."""
    return RecordedDepth in _kinds(choice).values()


def may_be_metric(choice: str) -> bool:
    """Return True if depth by a setting can have a known scale."""
    kinds = _kinds(choice).values()
    return RecordedDepth in kinds or any(kind.origin is not None and kind.origin.scale != "relative" for kind in kinds)


def evidence(choice: str, fields: frozenset[str]) -> list[str]:
    """Return what may show the distance in frames with some fields of `Frame`, as noun phrases."""
    kinds = _kinds(choice).values()
    return [kind.evidence for kind in kinds if kind.evidence and (kind.needs is None or kind.needs in fields)]


def of_recording(choice: str) -> str | None:
    """Return which estimator of a setting needs all frames of a recording, by name; None if none does."""
    return next((name for name, kind in _kinds(choice).items() if issubclass(kind, OfRecording)), None)


def depth_inputs(choice: str) -> tuple[Path, ...]:
    """Return the files that the setting `choice` of the depth source makes it read; often none."""
    name, _, address = choice.partition(":")
    path = address.partition("?")[0]
    return (Path(path),) if name in WITH_ADDRESS and path else ()


def new_estimator(choice: str) -> Estimator:
    """Create the estimator `choice` for one stream. Raises like `check_depth`."""
    name, _, address = choice.partition(":")
    new: Callable[..., Estimator] = DEPTHS[name]
    return new(address) if name in WITH_ADDRESS else new()


class Sentences:
    """Counter of messages about frames. Messages with equal text before the first colon count as one kind."""

    def __init__(self) -> None:
        self._first: dict[str, str] = {}
        self._frames: Counter[str] = Counter()

    def add(self, sentence: str | None) -> None:
        """Count a message about one frame by its kind, the text before a colon; None is ignored."""
        if sentence is not None:
            kind = sentence.partition(":")[0]
            self._first.setdefault(kind, sentence)
            self._frames[kind] += 1

    def counted(self) -> dict[str, int]:
        """Return the first message of each kind with its number of frames."""
        return {self._first[kind]: frames for kind, frames in sorted(self._frames.items())}


class DepthFinder:
    """Selects the depth of each frame of one stream according to a setting."""

    def __init__(self, choice: str, camera: Camera, *, has_time: bool = False, device: str = "cpu") -> None:
        """Create the estimators of a stream.

        Args:
            choice: `auto` or a name for `new_estimator`.
            camera: camera of the frames.
            has_time: let `auto` use slow estimators as well.
            device: device for estimators that support one.

        Raises:
            InvalidSetting: like `check_depth`.
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
        """Reasons for rejected depth maps, and remarks about used ones."""

    def seeks_in(self, frame: Frame) -> bool:
        """Return True if any source other than the frame's own depth applies to a frame."""
        return any(
            suits(frame) for estimator, suits in self._asked if not isinstance(estimator, RecordedDepth | NoDepth)
        )

    def find(self, frame: Frame, *, shown_only: bool = False) -> DepthMap | None:
        """Return the first depth map that is not rejected, or None.

        Args:
            frame: frame to find depth for.
            shown_only: the frame is displayed but not used for training, so only its own depth is returned.
        """
        camera = self._camera if frame.pose is None else self._camera.with_pose(frame.pose)
        if (camera.width_px, camera.height_px) != (
            frame.width_px,
            frame.height_px,
        ):  # the stream may have changed its picture size
            camera = camera.resized(frame.width_px, frame.height_px)
        # Frames that are not trained on need no estimated depth; their own depth is free.
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
        """Return the frame with the selected depth, or without depth if there is none."""
        found = self.find(frame, shown_only=shown_only)
        if found is None:
            return frame.with_fields(depth=None, depth_confidence=None, depth_origin=None, depth_error=None)
        if found.depth is frame.depth:
            # A second plane is stored only if some known depth is rejected.
            doubts = bool(np.any((found.confidence == 0) & (frame.depth > 0)))
            return frame.with_fields(depth_confidence=found.confidence) if doubts else frame
        return frame.with_fields(
            depth=found.kept, depth_confidence=found.confidence, depth_origin=found.origin, depth_error=found.error
        )
