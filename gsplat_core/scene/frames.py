"""Frames of endoscopic video with their sensor data, and the origins of their depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.registry import Registry
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.range_sensors import RangeScan, resized_scan

BELIEVED = 0.5
"""Smallest confidence of a depth value that is used, in code that either uses a value fully or ignores it."""


@dataclass(frozen=True)
class DepthOrigin:
    """Origin of depth, with the uses that its accuracy permits. The defaults suit an estimator without a known scale."""

    name: str
    """Name of the origin in files and reports."""
    relative_error: float
    """Assumed standard error relative to the depth, in addition to the errors visible in a model."""
    scale: Literal["metric", "calibrated", "relative"] = "relative"
    """`metric`: in millimetres. `calibrated`: in millimetres if the frame's right camera is known. `relative`: known up to
    one factor.
    """
    is_recorded: bool = False
    """True for depth supplied with a frame, False for depth estimated from pictures."""
    initialises_only: bool = False
    """True if the depth only initialises a new scene, and is neither trained on nor used to correct the scene later. For
    estimators whose scale changes from frame to frame.
    """
    is_of_still_tissue: bool = False
    """True if the depth assumes static tissue. It then corrects the scene at all times, otherwise only at its frame's
    time.
    """
    loss_weight_online: float = 1.0
    """Factor of `ReconstructorConfig.depth_weight` in training frame by frame, for a scene that starts from this depth."""
    loss_weight_offline: float = 1.0
    """Factor of `ReconstructorConfig.depth_weight` in training on a complete recording that starts from this depth."""
    right_share_offline: float | None = None
    """`LearningRates.right_share` in training on a complete recording. None keeps the setting, which lets colour
    differences between the eyes move Gaussians.
    """
    least_confidence: float = BELIEVED
    """Smallest confidence at which the depth is a better start value of new Gaussians than an extrapolation of its
    surroundings.
    """
    edge_margin_px: int = 0
    """Margin in pixels around unknown depth within which the depth is not trained on. Half of it applies to start values of
    new Gaussians.
    """
    tool_margin_px: int = 0
    """Margin in pixels around tools within which the depth may belong to the tool and starts no Gaussians."""
    surface: str | None = None
    """Import path of a function (frame, camera) -> frame, called before training on a complete recording. The function
    replaces the depth by a smooth surface. None to keep the depth.
    """

    def is_metric(self, eyes_calibrated: bool) -> bool:
        """Return True if depth of this origin is in millimetres. `eyes_calibrated`: the frame's right camera is known."""
        return self.scale == "metric" or (self.scale == "calibrated" and eyes_calibrated)


# The loss weights of measured depth are a compromise. With lower values, colour errors move Gaussians along the line of
# sight by more than the depth's error. Higher values leave less of a frame's few steps to its picture. Offline, colour
# errors would also roughen the surface fitted to stereo depth.
MEASURED = DepthOrigin(
    "measured", 0.005, "metric", is_recorded=True, loss_weight_online=3.0, loss_weight_offline=10.0
)  # fmt: skip
STEREO = DepthOrigin(
    "stereo", 0.0125, "calibrated", loss_weight_offline=10.0, right_share_offline=1.0, least_confidence=0.03,
    edge_margin_px=2, tool_margin_px=4, surface="gsplat_core.depth.pair_surface:with_matched_surface",
)  # fmt: skip
PARALLAX = DepthOrigin("parallax", 0.05, is_of_still_tissue=True)
LIGHT = DepthOrigin("light", 0.15, initialises_only=True)
LEARNED = DepthOrigin("learned", 0.2, initialises_only=True)

DEPTH_ORIGINS: Registry[DepthOrigin] = Registry(
    "depth origin", {origin.name: origin for origin in (MEASURED, STEREO, PARALLAX, LIGHT, LEARNED)}
)
"""Depth origins by name. Only these entries state how depth of an origin may be used; all other code reads them.

In this order: sensor or recording; matching between the eyes; matching across times, in the unit of
the poses; shading of the scope's light; prediction of a network.
"""
RELATIVE_DISTANCE = 60.0
"""Mean distance of depth whose scale is unknown, in arbitrary units."""
UNKNOWN_ERROR = 0.3
"""Assumed relative standard error of the depth of a model that was trained without depth."""


class FrameStatus(Enum):
    """Source (live or replay) or defect (stale or damaged) of a frame's picture."""

    LIVE = "live"
    REPLAY = "replay"
    STALE = "stale"
    DAMAGED = "damaged"
    """Picture that may contain the decoder's error concealment. It is displayed, but neither trained on nor scored."""


LONGEST_RECORDING_S = 86_400.0
"""Longest recording, and longest time window of a model: one day."""
BLUR, CUT_IN_DOUBT = "blur", "cut in doubt"
"""Values of `Frame.withheld` for a blurred frame, and for one that may belong to another scene."""


@dataclass(frozen=True)
class Frame:
    """Video frame with its sensor data. Operators replace frames by changed copies and never modify them."""

    seq: int
    """Sequence number in the stream, from 0. Increases strictly; lost frames leave gaps."""
    pts_ns: int
    """Presentation time in nanoseconds of the recording's clock."""
    image: NDArray[np.uint8]
    """Picture of the (left) camera, RGB uint8 [H, W, 3]."""
    right_image: NDArray[np.uint8] | None = None
    """Picture of the right eye of a rectified stereo pair, RGB uint8 [H, W, 3]; None without one."""
    right_camera: Camera | None = None
    """Camera of `right_image`; its pose maps left-camera coordinates to its own. None if unknown."""
    depth: NDArray[np.float32] | None = None
    """Depth z [H, W], 0 = unknown; in millimetres if `depth_is_metric`, otherwise in an unknown unit."""
    depth_confidence: NDArray[np.float32] | None = None
    """Confidence of each pixel's depth [H, W], 0 to 1; None for full confidence."""
    depth_origin: DepthOrigin | None = None
    """Origin of `depth`; None without depth. Depth without an origin counts as recorded with the frame (`MEASURED`)."""
    depth_error: float | None = None
    """Typical standard error of `depth`, relative to the depth; None for the error assumed for its origin."""
    ranges: RangeScan | None = None
    """Scan of a range sensor at the camera's position; None without one."""
    mask: NDArray[np.uint8] | None = None
    """Tissue mask uint8 [H, W]: 1 tissue, 0 tool. None for tissue everywhere."""
    pose: NDArray[np.float64] | None = None
    """World-to-camera matrix [4, 4] in OpenCV axes; None if unknown."""
    status: FrameStatus = FrameStatus.REPLAY
    damage: str | None = None
    """Description of the damage of a damaged picture; None for an intact frame."""
    arrived_ns: int | None = None
    """Arrival time of a live frame in nanoseconds of `time.monotonic_ns`; None if not live."""
    loss_mask: NDArray[np.uint8] | None = None
    """Loss mask uint8 [H, W]; 0 excludes a pixel from the loss although it may be tissue.

    Used outside the field of view and for a recorder's overlay. None excludes nothing.
    """
    labels: NDArray[np.uint8] | None = None
    """Class of each pixel uint8 [H, W] for the loss `semantics`; 255 = unknown. None for a frame without labels."""
    withheld: str | None = None
    """Reason for withholding the frame from training and scores ("blur", "out of body"); None for a usable frame. A live
    model is trained on some of them all the same (`is_followed`)."""
    new_scene: str | None = None
    """Reason for a scene change at this frame ("cut", "resized"); None if the scene continues."""
    scene: int = 0
    """Scene id; lets a consumer that missed the first frame of a scene detect the change."""
    deinterlaced: bool = False
    """True if combs of interlaced video were removed from the picture, which also removes detail."""

    @property
    def unusable(self) -> str | None:
        """Reason for neither training on the frame nor scoring it: the one in `withheld`, or
        "damaged". None for a usable frame.
        """
        if self.withheld is not None:
            return self.withheld
        return "damaged" if self.status is FrameStatus.DAMAGED else None

    @property
    def is_followed(self) -> bool:
        """True if a model that is displayed frame by frame is trained on the frame although it is withheld.

        Blur and doubt about a cut last a few frames. A display that waits for them to end shows tissue that has moved on.
        """
        return self.withheld in (BLUR, CUT_IN_DOUBT) and self.status is not FrameStatus.DAMAGED

    @property
    def can_be_shown(self) -> bool:
        """True if a display without a model could show the frame's picture, as the trivial baselines do. False for a picture that
        is withheld and not followed, such as a black one.
        """
        return self.withheld is None or self.withheld in (BLUR, CUT_IN_DOUBT)

    @property
    def tissue(self) -> NDArray[np.uint8] | None:
        """Intersection of `mask` and `loss_mask`, uint8 [H, W], 0 = excluded; None if the frame has neither."""
        if self.mask is None or self.loss_mask is None:
            return self.mask if self.loss_mask is None else self.loss_mask
        return np.minimum(self.mask, self.loss_mask)

    def excluding(self, kept: NDArray[np.uint8] | None) -> Frame:
        """Return the frame with further pixels excluded from the loss.

        Args:
            kept: uint8 [H, W], 0 = excluded; `loss_mask` stays in effect. With None, or a mask for another picture size, the
                frame itself is returned.
        """
        if kept is None or kept.shape != self.image.shape[:2]:
            return self
        return self.with_fields(loss_mask=kept if self.loss_mask is None else np.minimum(self.loss_mask, kept))

    def __post_init__(self) -> None:
        if self.depth is not None and self.depth_origin is None:
            object.__setattr__(self, "depth_origin", MEASURED)
        image = self.image
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidInput(
                f"frame {self.seq}: image must be RGB uint8 [H, W, 3], got {image.dtype} {list(image.shape)}"
            )
        size = image.shape[:2]
        if self.right_image is not None and self.right_image.shape != image.shape:
            raise InvalidInput(
                f"frame {self.seq}: right image {list(self.right_image.shape)} differs from left {list(image.shape)}"
            )
        right = self.right_camera
        if right is not None and (right.height_px, right.width_px) != size:
            raise InvalidInput(
                f"frame {self.seq}: its right camera is {right.width_px}x{right.height_px}, the image {size[1]}x{size[0]}"
            )
        planes = {name: getattr(self, name) for name in ("depth", "depth_confidence", "mask", "loss_mask", "labels")}
        for name, plane in planes.items():
            if plane is not None and plane.shape != size:
                raise InvalidInput(f"frame {self.seq}: {name} is {list(plane.shape)}, the image is {list(size)}")
        if self.pose is not None and self.pose.shape != (4, 4):
            raise InvalidInput(f"frame {self.seq}: pose must be [4, 4] world-to-camera, got {list(self.pose.shape)}")
        if self.depth_error is not None and not (math.isfinite(self.depth_error) and self.depth_error >= 0):
            raise InvalidInput(f"frame {self.seq}: depth_error is {self.depth_error}; it must be at least 0")

    @property
    def time_s(self) -> float:
        """Presentation time in seconds."""
        return self.pts_ns * 1e-9

    @property
    def depth_is_metric(self) -> bool:
        """True if the unit of `depth` is known.

        The answer stays valid after `depth` was dropped to save memory, because `depth_origin` is kept.
        """
        return self.depth_origin is not None and self.depth_origin.is_metric(self.right_camera is not None)

    @property
    def height_px(self) -> int:
        return int(self.image.shape[0])

    @property
    def width_px(self) -> int:
        return int(self.image.shape[1])

    def with_fields(self, **fields: Any) -> Frame:
        """Return a copy with some fields replaced."""
        return replace(self, **fields)


PLANES = ("depth", "depth_confidence", "mask", "loss_mask", "labels")
"""Fields of `Frame` with one value per pixel of the left image."""


def resized_frame(frame: Frame, width_px: int, height_px: int) -> Frame:
    """Resize a frame: images and scans by area averaging, masks, labels and depth by nearest-neighbour sampling."""
    if (width_px, height_px) == (frame.width_px, frame.height_px):
        return frame
    planes = {name: getattr(frame, name) for name in PLANES}
    scan = frame.ranges
    right, right_camera = frame.right_image, frame.right_camera
    return frame.with_fields(
        image=resize_area(frame.image, width_px, height_px),
        ranges=None if scan is None else resized_scan(scan, width_px, height_px / frame.height_px),
        right_image=None if right is None else resize_area(right, width_px, height_px),
        right_camera=None if right_camera is None else right_camera.resized(width_px, height_px),
        **{name: resize_nearest(plane, width_px, height_px) for name, plane in planes.items() if plane is not None},
    )


def resize_area(image: NDArray[np.uint8], width_px: int, height_px: int) -> NDArray[np.uint8]:
    """Resize an image [H, W, C], by area averaging if it becomes smaller."""
    import cv2  # imported only here, because the control plane passes frames on without OpenCV

    shrinks = width_px <= image.shape[1] and height_px <= image.shape[0]
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width_px, height_px), interpolation=interpolation), dtype=np.uint8)


def resize_nearest(plane: NDArray[Any], width_px: int, height_px: int) -> NDArray[Any]:
    """Resize a mask or depth map by nearest-neighbour sampling, which creates no new values."""
    import cv2

    return cv2.resize(plane, (width_px, height_px), interpolation=cv2.INTER_NEAREST_EXACT)


class DepthError(NamedTuple):
    """Error of a model's depth at one time."""

    time_s: float
    relative: float
    """Standard error of the model's depth z at that time, relative to z."""


@dataclass(frozen=True)
class DepthSource:
    """Depth source of the frames that a model was trained on."""

    origin: DepthOrigin
    """Origin of the first frame's depth, from which the scene was initialised."""
    metric: bool
    """True if the unit of all depth is known; the model's lengths are then millimetres."""
    errors: tuple[DepthError, ...] = ()
    """Measured errors of the model's depth, in temporal order; empty if they were not measured."""

    def relative_error(self, time_s: float) -> float:
        """Return the relative standard error of the model's depth at a time, interpolated between the measured ones.

        Without measured errors it is the one assumed for the origin.
        """
        if not self.errors:
            return self.origin.relative_error
        times, values = zip(*self.errors, strict=True)
        return float(np.interp(time_s, times, values))

    @staticmethod
    def of_first(frame: Frame) -> DepthSource | None:
        """Return the depth source of a model whose scene is initialised from `frame`.

        None without depth; the scene then starts on a plane at an arbitrary distance.
        """
        if frame.depth is None or frame.depth_origin is None:
            return None
        return DepthSource(frame.depth_origin, frame.depth_is_metric)

    @staticmethod
    def after(source: DepthSource | None, frame: Frame) -> DepthSource | None:
        """Return the depth source of a model that has been trained on one more frame: `source` (also None), but not metric if the
        frame's depth is not. A scene initialised on a plane never becomes metric.
        """
        relative = frame.depth is not None and not frame.depth_is_metric
        return replace(source, metric=False) if source is not None and relative else source
