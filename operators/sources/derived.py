"""Sources derived from other sources: resized, given other poses, split into two eyes, or joined from two eyes."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsplat_core.choices import StereoLayout
from gsplat_core.endoscope.sequence import picture_fault
from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.calibration import default_camera
from gsplat_core.io.recordings.packed_eyes import TWO_EYES
from gsplat_core.scene.frames import PLANES, Frame, resized_frame
from operators.sources.live import LiveSource
from operators.sources.source import FrameSource, ReportingSource, SourceDescription, SourceState


class DerivedSource:
    """`FrameSource` that changes each frame of another source. A subclass implements `_derived`."""

    def __init__(self, source: FrameSource, description: SourceDescription) -> None:
        """Create a source with the frames of `source` and another description.

        Args:
            source: opened and closed together with this one.
            description: description of the changed frames.
        """
        self._source = source
        self.description = description

    @property
    def state(self) -> SourceState:
        """State of the wrapped source."""
        return self._source.state

    @property
    def state_sentence(self) -> str:
        """State of the wrapped source as a sentence; empty if it is no `ReportingSource`."""
        return self._source.state_sentence if isinstance(self._source, ReportingSource) else ""

    def counts(self) -> Mapping[str, int]:
        """Return the wrapped source's numbers of dropped or repaired items, by reason."""
        return self._source.counts() if isinstance(self._source, ReportingSource) else {}

    def open(self) -> None:
        """Open the wrapped source."""
        self._source.open()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame of the wrapped source, changed; None if none arrived within `timeout_s`."""
        frame = self._source.read(timeout_s)
        return None if frame is None else self._derived(frame)

    def close(self) -> None:
        """Close the wrapped source."""
        self._source.close()

    def _derived(self, frame: Frame) -> Frame:
        raise NotImplementedError(f"{type(self).__name__} has no _derived method")


def scaled_description(about: SourceDescription, scale: float) -> SourceDescription:
    """Return the description of the same source with frames resized by `scale`."""
    camera = about.camera.scaled(scale)
    return replace(about, width_px=camera.width_px, height_px=camera.height_px, camera=camera)


class ScaledSource(DerivedSource):
    """`FrameSource` that resizes the frames of another source."""

    def __init__(self, source: FrameSource, scale: float) -> None:
        """Create a source with the frames of `source`, resized.

        Args:
            source: opened and closed together with this one.
            scale: factor on width and height.
        """
        super().__init__(source, scaled_description(source.description, scale))

    def _derived(self, frame: Frame) -> Frame:
        # A frame whose size differs from the description is scaled by the same factor, not to the described size.
        own, read = self.description, self._source.description
        if (frame.width_px, frame.height_px) == (read.width_px, read.height_px):
            return resized_frame(frame, own.width_px, own.height_px)
        scale = own.width_px / read.width_px
        sides = (max(1, round(side * scale)) for side in (frame.width_px, frame.height_px))
        return resized_frame(frame, *sides)


class PosedSource(DerivedSource):
    """`FrameSource` that gives the frames of another source poses."""

    def __init__(self, source: FrameSource, pose_of: Callable[[Frame], NDArray[np.float64]]) -> None:
        """Create a source with the frames of `source`.

        Args:
            source: opened and closed together with this one. Its poses, if any, are replaced.
            pose_of: returns the world-to-camera pose [4, 4] of a frame.
        """
        super().__init__(source, replace(source.description, fields=source.description.fields | {"pose"}))
        self._pose_of = pose_of

    def _derived(self, frame: Frame) -> Frame:
        return frame.with_fields(pose=self._pose_of(frame))


class JudgedSource(DerivedSource):
    """`FrameSource` that withholds frames of another source whose picture shows nothing, such as a black one, and excludes
    given pixels from the loss.

    Unlike the checks of a stream, it examines each picture alone. The result for a frame is therefore the same each time
    that the frame is read.
    """

    def __init__(self, source: FrameSource, seen: NDArray[np.uint8] | None = None) -> None:
        """Create a source with the frames of `source`.

        Args:
            source: opened and closed together with this one.
            seen: mask for all pictures, uint8 [H, W], 0 = excluded from the loss; None to exclude no pixel.
        """
        super().__init__(source, source.description)
        self._seen = seen

    def _derived(self, frame: Frame) -> Frame:
        fault = None if frame.unusable else picture_fault(frame.image)
        return frame.excluding(self._seen) if fault is None else replace(frame, withheld=fault)


MOST_KEPT = 8
"""Maximum number of right pictures kept for pairing."""


class SplitSource(DerivedSource):
    """`FrameSource` that splits each picture into a left or upper half (`image`) and the other half (`right_image`).

    Halves that the sender has squeezed are not stretched. All other fields belong to the left eye.
    """

    def __init__(self, source: FrameSource, layout: StereoLayout) -> None:
        """Wrap a source with pictures of their full size.

        Raises:
            InvalidSetting: if it already has right pictures, has range scans, or its camera is not that of one eye.
        """
        self._layout = layout
        super().__init__(source, self._described(source.description))

    def _derived(self, frame: Frame) -> Frame:
        width_px, height_px = self._half(frame.width_px, frame.height_px)

        def left(plane: NDArray) -> NDArray:
            return np.ascontiguousarray(plane[:height_px, :width_px])

        beside = self._layout == "side_by_side"
        right = frame.image[:, width_px : 2 * width_px] if beside else frame.image[height_px : 2 * height_px]
        planes = {name: getattr(frame, name) for name in PLANES}
        return frame.with_fields(
            image=left(frame.image),
            right_image=np.ascontiguousarray(right[:height_px, :width_px]),
            **{name: left(plane) for name, plane in planes.items() if plane is not None},
        )

    def _half(self, width_px: int, height_px: int) -> tuple[int, int]:
        # A side of one pixel cannot be halved; both eyes then get the whole picture.
        if self._layout == "side_by_side":
            return max(1, width_px // 2), height_px
        return width_px, max(1, height_px // 2)

    def _described(self, about: SourceDescription) -> SourceDescription:
        if "right_image" in about.fields:
            raise InvalidSetting(f"{about.name} has a right picture for each frame; leave out stereo={self._layout}")
        if "ranges" in about.fields:
            raise InvalidSetting(
                f"{about.name} has range scans, which cannot be split; leave out stereo={self._layout}"
            )
        width_px, height_px = self._half(about.width_px, about.height_px)
        if (about.width_px if self._layout == "side_by_side" else about.height_px) < 2:
            raise InvalidSetting(
                f"{about.name} has pictures of {about.width_px}x{about.height_px} px, which are not two eyes {self._layout.replace('_', ' ')}"
            )
        camera, notes = about.camera, [note for note in about.notes if TWO_EYES not in note]
        if np.allclose(camera.K, default_camera(about.width_px, about.height_px).K):
            camera = default_camera(width_px, height_px)
            assumed, of_one = (f"f = {each.K[0, 0]:.1f} px" for each in (about.camera, camera))
            notes = [note.replace(assumed, of_one) for note in notes]
        elif camera.K[0, 2] < width_px and camera.K[1, 2] < height_px:
            camera = replace(camera, width_px=width_px, height_px=height_px)
        else:
            raise InvalidSetting(
                f"the calibration of {about.name} is not that of its left eye: the principal point ({camera.K[0, 2]:g}, {camera.K[1, 2]:g}) "
                f"lies outside of {width_px}x{height_px} px"
            )
        return replace(
            about,
            width_px=width_px,
            height_px=height_px,
            camera=camera,
            fields=about.fields | {"right_image"},
            digest=None,
            notes=tuple(notes),
        )


class JoinedSource(LiveSource):
    """Pairs each frame of the left source with the frame of the right source closest in arrival time.

    A left frame waits for its right one for at most half a frame interval. Without one it is emitted alone and counted as
    `without_right`, so that a lost eye never interrupts the stream.
    """

    def __init__(self, left: FrameSource, right: FrameSource, *, waiting: int = 2) -> None:
        """Create a source of stereo frames from a source per eye.

        Args:
            left: source of the left eye.
            right: source of the right eye.
            waiting: capacity of the queue for `read`, in frames.

        Raises:
            InvalidSetting: the sizes differ.
        """
        super().__init__(waiting=waiting, stalled_after_s=math.inf)
        self._left, self._right = left, right
        about, other = left.description, right.description
        if (about.width_px, about.height_px) != (other.width_px, other.height_px):
            raise InvalidSetting(
                f"the left eye has {about.width_px}x{about.height_px} px and the right one {other.width_px}x{other.height_px}; "
                "they must have one size"
            )
        self._apart_ns = round(0.5 / about.fps * 1e9)
        self.description = replace(
            about,
            name=f"{about.name} and {other.name}",
            fields=about.fields | {"right_image"},
            digest=None,
            notes=tuple(dict.fromkeys((*about.notes, *other.notes))),
        )

    @property
    def state(self) -> SourceState:
        """State of the left source while this source is open; `LIVE` while frames wait for `read`."""
        state = super().state
        return self._left.state if state is SourceState.LIVE and not self._ready else state

    @property
    def state_sentence(self) -> str:
        """State messages of the left and the right source, as one sentence."""
        eyes = [("left", self._left), ("right", self._right)]
        sentences = [f"{name} eye: {eye.state_sentence}" for name, eye in eyes if isinstance(eye, ReportingSource)]
        return "; ".join(sentences) or super().state_sentence

    def counts(self) -> Mapping[str, int]:
        """Return the counts of this source, and those of both eyes prefixed by `left` or `right`."""
        counts = Counter(super().counts())
        for name, eye in (("left", self._left), ("right", self._right)):
            if isinstance(eye, ReportingSource):
                counts.update({f"{name} {reason}": times for reason, times in eye.counts().items()})
        return dict(counts)

    def frames(self) -> Iterator[Frame]:
        """Yield the left frames, paired with right ones."""
        self._left.open()
        self._right.open()
        kept: deque[Frame] = deque(maxlen=MOST_KEPT)
        while not self.wait(0):
            frame = self._left.read(0.05)
            if frame is None:
                if self._left.state is SourceState.ENDED:
                    return
                continue
            yield self._paired(frame, kept)

    def close(self) -> None:
        """Stop reading and close both sources."""
        super().close()
        self._left.close()
        self._right.close()

    def _paired(self, frame: Frame, kept: deque[Frame]) -> Frame:
        at_ns = moment_ns(frame)
        until_s = time.monotonic() + self._apart_ns * 1e-9
        while not kept or moment_ns(kept[-1]) < at_ns:
            right = self._right.read(max(0.0, until_s - time.monotonic()))
            if right is None:
                break
            kept.append(right)
        best = min(kept, key=lambda each: abs(moment_ns(each) - at_ns), default=None)
        if best is None or abs(moment_ns(best) - at_ns) > self._apart_ns:
            self.count("without_right")
            return frame
        while kept and moment_ns(kept[0]) <= moment_ns(best):
            kept.popleft()
        if best.image.shape != frame.image.shape:
            self.count("right_of_another_size")
            return frame
        if frame.damage is None and best.damage is not None:
            # Stereo depth from one damaged picture is invalid, so the whole frame counts as damaged.
            return replace(frame, right_image=best.image, damage=f"right eye: {best.damage}", status=best.status)
        return replace(frame, right_image=best.image)


def moment_ns(frame: Frame) -> int:
    """Return a frame's arrival time, which is comparable between sources; its timestamp if not live."""
    return frame.pts_ns if frame.arrived_ns is None else frame.arrived_ns
