"""Depth maps with confidence, the estimators that return them, the selection of an estimator, and checks of the maps.

`DepthFinder` selects the depth of each frame of a stream by a setting, such as `auto` or the name of an estimator.

Depth of sensors, renderers and resized maps has edge pixels that belong to neither side, near-zero values next to
unknown depth, and wrong rows or columns along the border. Gaussians initialised at such depth float in front of the
tissue and occlude it when they move. `measured_confidence` rejects these pixels.

Depth by parallax is validated by a second map of the same tissue from another pose and time, which must show the same
relief (`agree`). The reprojection error does not reveal wrong poses or moving tissue. Tissue that moves evenly for a
while looks like static tissue at another distance, and a warp by the wrong depth fits as well as one by the true depth.
The tissue's motion changes over time, however, and so does the depth error that it causes. If two depth maps differ by
a fair share of the relief that they show, a level plane is as accurate as they are.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.choices import DEPTHS, DEPTHS_WITH_ADDRESS
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera, moved, pixel_rays, pixels_of
from gsplat_core.scene.frames import BELIEVED, DepthOrigin, Frame, FrameStatus


@dataclass(frozen=True)
class DepthMap:
    """Depth estimated for one picture.

    Raises:
        InvalidInput: for planes that are not float32 [H, W] of one shape, or a rejected map with non-zero confidence.
    """

    depth: NDArray[np.float32]
    """Depth along the optical axis, float32 [H, W]; 0 = unknown. In millimetres if `metric`."""
    confidence: NDArray[np.float32]
    """Probability that the depth is right, float32 [H, W], 0 to 1; 0 where the depth is unknown."""
    origin: DepthOrigin
    metric: bool
    """True if the depth is in millimetres; otherwise it is known up to one factor."""
    error: float | None = None
    """Typical standard error of the confident depth, relative to the depth; None for the error assumed for its origin."""
    doubt: str | None = None
    """Reason why the whole map is rejected, as a sentence; None if it is not. A rejected map has no confidence anywhere."""

    remark: str | None = None
    """Information for the user about the whole map, as a sentence, or None. Like `doubt`, its text
    up to the first colon does not depend on numbers, so repeated messages can be recognised.
    """

    def __post_init__(self) -> None:
        for name in ("depth", "confidence"):
            plane = getattr(self, name)
            if plane.ndim != 2 or plane.dtype != np.float32 or plane.shape != self.depth.shape:
                raise InvalidInput(
                    f"{name} must be float32 {list(self.depth.shape)}, got {plane.dtype} {list(plane.shape)}"
                )
        if self.doubt is not None and np.any(self.confidence):
            raise InvalidInput("a depth map with a doubt must have confidence 0 everywhere")

    @property
    def believed(self) -> NDArray[np.float32]:
        """Depth map [H, W] with 0 where the confidence is below `BELIEVED`."""
        return np.where(self.confidence >= BELIEVED, self.depth, np.float32(0))

    @property
    def kept(self) -> NDArray[np.float32]:
        """Depth [H, W] that is stored with the frame, with 0 where the confidence is below the `least_confidence` of the map's
        origin.
        """
        return np.where(self.confidence >= self.origin.least_confidence, self.depth, np.float32(0))


def doubted(shape: tuple[int, int], origin: DepthOrigin, doubt: str) -> DepthMap:
    """Return a rejected depth map [H, W] without depth, with the reason."""
    nothing = np.zeros(shape, np.float32)
    return DepthMap(nothing, nothing, origin, metric=False, doubt=doubt)


class Estimator(ABC):
    """Base class of depth estimators of one stream. Frames are passed in order, and an estimator may keep state. Equal
    frames give bit-identical results.
    """

    origin: ClassVar[DepthOrigin | None] = None
    """Origin of the estimated depth. None if the estimator passes on the frame's own depth or returns no depth."""
    needs: ClassVar[str | None] = None
    """Field of `Frame` that the estimator requires; None if the picture suffices."""
    evidence: ClassVar[str | None] = None
    """Noun phrase for messages that names the evidence of distance; None if the estimator estimates nothing."""

    @abstractmethod
    def estimate(self, frame: Frame, camera: Camera) -> DepthMap | None:
        """Estimate the depth of a frame.

        Args:
            frame: frame; `new_scene` marks a cut after which earlier frames are unrelated.
            camera: camera of the frame, with its pose if known.

        Returns:
            The depth map, or None if the frame contains nothing to estimate depth from.
        """


class RecordingDepth(NamedTuple):
    """Depth estimated from all frames of a recording together."""

    frames: list[Frame]
    """All frames of the recording; those with estimated depth have it in the unit of the camera positions. Depth without confidence is
    an extrapolation.
    """
    doubts: Mapping[str, int]
    """Reasons why frames of the recording have no depth, as sentences with numbers of frames."""
    at_rest: bool = False
    """True if depth was estimated for static tissue; differences between frames are then errors, not motion."""


@runtime_checkable
class OfRecording(Protocol):
    """Estimator that uses all frames of a recording at once. Training on a complete recording calls it in place of
    `estimate`.
    """

    def of_recording(self, frames: Sequence[Frame], cameras: Sequence[Camera]) -> RecordingDepth:
        """Estimate depth for frames of a recording. Frames are returned unchanged if the estimator does not apply, for
        example because they have depth.

        Args:
            frames: frames in temporal order.
            cameras: camera of each frame, with its pose.
        """
        ...


@runtime_checkable
class OnDevice(Protocol):
    """Estimator that can run on a device other than the CPU."""

    def work_on(self, device: str) -> None:
        """Run the estimator on this device from now on, concurrently with other work there."""
        ...


class RecordedDepth(Estimator):
    """Depth source that passes on the frame's own depth. If the frame has no confidence, outlier pixels are rejected
    (`measured_confidence`).
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
"""Depth sources that the setting `auto` tries in real-time use, in order, each with the condition that a frame must meet."""
AUTO_WITH_TIME: dict[str, Callable[[Frame], bool]] = {**AUTO, "parallax": _has_pose}
"""Depth sources that the setting `auto` tries without a real-time limit, each with the condition that a frame must meet."""


def check_depth(choice: str) -> None:
    """Check the name of a depth source, and its address if the name has one.

    Raises:
        InvalidSetting: for an unknown name, a missing address, or an address that the estimator rejects.
    """
    name, colon, address = choice.partition(":")
    if name in DEPTHS_WITH_ADDRESS and not address:
        raise InvalidSetting(f"depth is {choice!r}; it needs an address: {DEPTHS_WITH_ADDRESS[name]}")
    if choice != "auto" and (name not in DEPTHS or (colon and name not in DEPTHS_WITH_ADDRESS)):
        names = (DEPTHS_WITH_ADDRESS.get(each, each) for each in DEPTHS)
        raise InvalidSetting(f"depth is {choice!r}; choose auto, {', '.join(names)}")
    if name in DEPTHS_WITH_ADDRESS:
        new_estimator(choice)


def with_surface(frame: Frame, camera: Camera) -> Frame:
    """Return the frame with its depth smoothed by the `surface` function of the depth's origin, if there is one."""
    if frame.depth is None or frame.depth_origin is None or frame.depth_origin.surface is None:
        return frame
    module, function = frame.depth_origin.surface.split(":")
    smoothed: Frame = getattr(importlib.import_module(module), function)(frame, camera)
    return smoothed


def _kinds(choice: str) -> dict[str, type[Estimator]]:
    """Return the estimators that the depth setting `choice` may use, by name; several for `auto`."""
    return {name: DEPTHS[name] for name in (AUTO_WITH_TIME if choice == "auto" else (choice.partition(":")[0],))}


def keeps_recorded(choice: str) -> bool:
    """Return True if frames keep their recorded depth with the depth setting `choice`."""
    return RecordedDepth in _kinds(choice).values()


def may_be_metric(choice: str) -> bool:
    """Return True if the depth setting `choice` can give depth of known scale (millimetres)."""
    kinds = _kinds(choice).values()
    return RecordedDepth in kinds or any(kind.origin is not None and kind.origin.scale != "relative" for kind in kinds)


def evidence(choice: str, fields: frozenset[str]) -> list[str]:
    """Return noun phrases for messages that name the evidence of distance which the depth setting `choice` uses.

    Args:
        choice: depth setting.
        fields: fields of `Frame` that the frames have; estimators that need another field are left out.
    """
    kinds = _kinds(choice).values()
    return [kind.evidence for kind in kinds if kind.evidence and (kind.needs is None or kind.needs in fields)]


def of_recording(choice: str) -> str | None:
    """Return the name of the estimator of the depth setting `choice` that needs all frames of a recording; None if none does."""
    return next((name for name, kind in _kinds(choice).items() if issubclass(kind, OfRecording)), None)


def depth_inputs(choice: str) -> tuple[Path, ...]:
    """Return the files that the depth setting `choice` reads, such as a network; empty for most settings."""
    name, _, address = choice.partition(":")
    path = address.partition("?")[0]
    return (Path(path),) if name in DEPTHS_WITH_ADDRESS and path else ()


def new_estimator(choice: str) -> Estimator:
    """Create the estimator `choice` for one stream. Raises like `check_depth`."""
    name, _, address = choice.partition(":")
    new: Callable[..., Estimator] = DEPTHS[name]
    return new(address) if name in DEPTHS_WITH_ADDRESS else new()


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
    """Selection of the depth of each frame of a stream: tries the estimators of a depth setting (`auto` or a name) in order."""

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
        """Counters of the reasons for rejected depth maps, and of the remarks about used depth maps."""

    def seeks_in(self, frame: Frame) -> bool:
        """Return True if, for a frame, depth may be estimated by any source other than the frame's own depth."""
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
        ):  # a stream may change its picture size, and the camera has to match it
            camera = camera.resized(frame.width_px, frame.height_px)
        # Estimate no depth for frames that are not trained on; passing on their own depth costs nothing.
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
            # Store a confidence plane only if it rejects some known depth; None means full confidence.
            doubts = bool(np.any((found.confidence == 0) & (frame.depth > 0)))
            return frame.with_fields(depth_confidence=found.confidence) if doubts else frame
        return frame.with_fields(
            depth=found.kept, depth_confidence=found.confidence, depth_origin=found.origin, depth_error=found.error
        )


ALIKE = 0.1
"""Largest difference of the depths of neighbouring pixels on one surface, as a share of the larger depth."""
NEAREST = 0.1
"""Share of a map's median depth below which a value counts as unknown, because it is noise around zero."""
STRIDE = 4
"""Distance in pixels between the sampled rows and columns from which a map's median depth is computed."""
PAIRS = (
    (np.s_[:, :-1], np.s_[:, 1:]),
    (np.s_[:-1, :], np.s_[1:, :]),
    (np.s_[:-1, :-1], np.s_[1:, 1:]),
    (np.s_[:-1, 1:], np.s_[1:, :-1]),
)
"""Slices that pair every pixel with four of its eight neighbours. The pairs with the remaining four follow by symmetry.
"""


def measured_confidence(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the confidence of measured depth.

    A pixel gets 0 if its depth is not finite and positive, if it is far below the median, or if most of its known
    neighbours differ from it. Other pixels get 1, including those without known neighbours.

    Args:
        depth: floating [H, W].

    Returns:
        float32 [H, W], 0 or 1.
    """
    known = np.isfinite(depth) & (depth > 0)
    values = np.where(known, depth, 0).astype(np.float32)
    known &= values >= NEAREST * _median(values)
    balance = np.zeros(depth.shape, np.int8)
    for one, other in PAIRS:
        here, there = values[one], values[other]
        alike = np.abs(here - there) <= ALIKE * np.maximum(here, there)
        vote = np.where(alike, np.int8(1), np.int8(-1)) * (known[one] & known[other])
        balance[one] += vote
        balance[other] += vote
    return (known & (balance >= 0)).astype(np.float32)


def _median(values: NDArray[np.float32]) -> float:
    """Return the median of the positive values: of every `STRIDE`-th row and column, or of all pixels if these have none; 0
    without positive values.
    """
    for some in (values[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE], values):
        if np.any(some):
            return float(np.median(some[some > 0]))
    return 0.0


def believed_depth(frame: Frame) -> NDArray[np.float32]:
    """Return the frame's depth [H, W] where its confidence is at least `BELIEVED`; 0 elsewhere and within the edge margin
    (`DepthOrigin.edge_margin_px`) of such pixels. Depth without confidence is returned unchanged.
    """
    return _depth_from(frame, BELIEVED, 1.0)


def possible_depth(frame: Frame) -> NDArray[np.float32]:
    """Return the frame's depth [H, W] of tissue where it is a better start value than extrapolation, 0 elsewhere."""
    depth = _depth_from(frame, None, 0.5)
    if frame.mask is None or frame.depth_origin is None:
        return depth
    return np.where(_inner(frame.mask > 0, frame.depth_origin.tool_margin_px), depth, np.float32(0))


def _depth_from(frame: Frame, least: float | None, margin: float) -> NDArray[np.float32]:
    """Return the frame's depth [H, W] where its confidence is high enough, 0 elsewhere and near such pixels.

    Depth without confidence is returned unchanged.

    Args:
        frame: frame with depth.
        least: smallest confidence; None for `least_confidence` of the depth's origin.
        margin: width of the margin next to rejected pixels, as a share of the origin's `edge_margin_px`.
    """
    origin = frame.depth_origin
    if frame.depth is None or origin is None:
        return np.zeros(frame.image.shape[:2], np.float32)
    if frame.depth_confidence is None:
        return frame.depth
    known = frame.depth_confidence >= (origin.least_confidence if least is None else least)
    return np.where(_inner(known, int(margin * origin.edge_margin_px)), frame.depth, np.float32(0))


def _inner(where: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """Erode a bool mask [H, W] by `margin_px` pixels."""
    if margin_px == 0:
        return where
    side = 2 * margin_px + 1
    return np.asarray(cv2.erode(where.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


LONGEST_PX = 160
"""Longest side, in pixels, to which depth maps are reduced before two of them are compared (`agree`)."""
MOST_DISAGREEMENT = 0.25
"""Largest median difference of two depth maps that agree, as a share of the median relief (variation of depth) that they show."""
LEAST_SHARED = 0.1
"""Smallest share of the picture that two depth maps must both cover to be compared."""
UNCONFIRMED = "two depth maps by parallax disagree about the relief, so a level plane may be as accurate"
"""Rejection reason of a parallax depth map that a second one of the same tissue contradicts."""


@dataclass(frozen=True)
class ReducedDepth:
    """Depth map at reduced size with its camera, for the comparison of two maps (`agree`)."""

    inverse: NDArray[np.float32]
    """Inverse depth of a reduced depth map, [h, w]."""
    believed: NDArray[np.float32]
    """Validity [h, w]: 1 where the depth is confident, 0 elsewhere."""
    camera: Camera
    """Camera with its pose, scaled to the size of the map."""

    @classmethod
    def of(cls, depth: NDArray[np.float32], confidence: NDArray[np.float32] | None, camera: Camera) -> ReducedDepth:
        """Return the reduced depth map. Without a confidence, every known depth counts as confident.

        Args:
            depth: float32 [H, W], 0 = unknown.
            confidence: float32 [H, W], 0 to 1, or None.
            camera: camera at full size, with its pose.
        """
        known = (depth > 0) if confidence is None else (depth > 0) & (confidence >= BELIEVED)
        small = camera.scaled(min(1.0, LONGEST_PX / max(depth.shape)))
        size = small.width_px, small.height_px
        inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0).astype(np.float32)
        return cls(
            np.asarray(cv2.resize(inverse, size, interpolation=cv2.INTER_NEAREST), np.float32),
            np.asarray(cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_NEAREST), np.float32),
            small,
        )


def disagreement(first: ReducedDepth, second: ReducedDepth) -> float:
    """Return the median relative depth difference over the median relief of the second map;
    infinite if they share too little tissue.

    Differences of the overall distance count as well, since the poses determine it.
    """
    inverse = np.where(first.inverse > 0, first.inverse, 1)
    points = pixel_rays(first.camera) / inverse[..., None]
    between = second.camera.world_to_camera @ np.linalg.inv(first.camera.world_to_camera)
    seen = moved(between, points)
    pixels = np.nan_to_num(pixels_of(second.camera, seen) - 0.5, nan=-1e6, posinf=1e6, neginf=-1e6).astype(np.float32)
    there, known = (
        cv2.remap(
            plane, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        for plane in (second.inverse, second.believed)
    )
    shared = (first.believed > 0) & (known > 0.99) & (there > 0) & (seen[..., 2] > 0)
    if shared.mean() < LEAST_SHARED:
        return np.inf
    found = np.log(there[shared])
    relief = float(np.median(np.abs(found - np.median(found))))
    off = float(np.median(np.abs(found + np.log(seen[shared][:, 2]))))
    return off / relief if relief > 0 else np.inf


def agree(first: ReducedDepth, second: ReducedDepth) -> bool:
    """Return True if two depth maps of the same tissue confirm each other: they differ by at most `MOST_DISAGREEMENT`."""
    return disagreement(first, second) <= MOST_DISAGREEMENT
