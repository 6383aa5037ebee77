"""Contents of a recording independent of its layout: images, sidecars and cameras.

Read-ahead: a thread produces the next items of an iterator while the current one is processed.
"""

from __future__ import annotations

import hashlib
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsplat_core.depth.rectification import Rectification, Undistortion
from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.calibration import Calibration
from gsplat_core.io.recordings.frame_files import DepthFiles, LabelFiles, MaskFiles, ScanFiles
from gsplat_core.io.recordings.plain_files import Findings, Picture, UnreadableFile, open_plain, printable
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.range_sensors import RangeScan

T = TypeVar("T")
ITEMS_AHEAD = 2


def read_ahead(items: Generator[T, None, None], name: str, ahead: int = ITEMS_AHEAD) -> Generator[T, None, None]:
    """Yield the items in order, produced by a thread at most `ahead` items in advance.

    An exception of the iterator is raised here after the preceding items. Closing this generator
    stops the thread and joins it; the iterator is closed in that thread. The thread is a daemon, so
    a blocked disk does not prevent the program from ending.

    Args:
        items: generator to run in the thread.
        name: thread name.
        ahead: maximum number of items produced but not yet consumed.
    """
    made = _Made[T](ahead)
    thread = threading.Thread(target=made.fill, args=(items,), name=name, daemon=True)
    thread.start()
    try:
        yield from made.taken()
    finally:
        made.stop()
        # The garbage collector may close the generator in any thread, also in the producing one.
        if thread is not threading.current_thread():
            thread.join()


class _Made(Generic[T]):
    """Bounded queue between the thread that produces items and the consumer."""

    def __init__(self, ahead: int) -> None:
        self._ahead = ahead
        self._changed = threading.Condition()
        self._items: deque[T] = deque()
        self._stopped = self._done = False
        self._error: BaseException | None = None

    def fill(self, items: Generator[T, None, None]) -> None:
        """Produce the items in the background thread until the iterator ends, raises (kept for the consumer), or `stop`
        is called.
        """
        error: BaseException | None = None
        try:
            try:
                while self._wait_for_room():
                    self._put(next(items))
            except StopIteration:
                pass
            finally:
                items.close()
        except BaseException as raised:  # noqa: BLE001 - carried to the thread that takes the items
            error = raised
        with self._changed:
            self._done, self._error = True, error
            self._changed.notify_all()

    def taken(self) -> Generator[T, None, None]:
        """Yield the items in the consumer's thread."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._items or self._done)
                if not self._items:
                    break
                item = self._items.popleft()
                self._changed.notify_all()
            yield item
        error, self._error = self._error, None
        if error is not None:
            raise error

    def stop(self) -> None:
        """Stop the producing thread after its current item."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def _wait_for_room(self) -> bool:
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or len(self._items) < self._ahead)
            return not self._stopped

    def _put(self, item: T) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify_all()


class FrameImages(Protocol):
    """Interface of images of one size in frame order, from a video or a list of files."""

    files: tuple[Path, ...]
    numbers: list[int | None]
    frame_count: int
    width_px: int
    height_px: int
    times: Sequence[float] | None
    """Capture times in frame durations since the first frame; None if evenly spaced."""
    fps: float | None
    """Frame rate in Hz; None if the files do not state it."""

    def frames(self, findings: Findings) -> Iterator[Picture | None]:
        """Yield the pictures in order; None for one that cannot be read at all."""
        ...


class _Beside(NamedTuple):
    """Sidecar data of one image, and the problems found in them."""

    right: Picture | None = None
    depth: NDArray[np.float32] | None = None
    mask: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None
    scan: RangeScan | None = None
    found: Findings = Findings()


@dataclass(frozen=True)
class Contents:
    """Recording that passed all checks except decoding."""

    root: Path
    layout: str
    images: FrameImages
    calibration: Calibration
    fps: float
    right: FrameImages | None = None
    masks: MaskFiles | None = None
    valid_mask: NDArray[np.uint8] | None = None
    """Mask uint8 [H, W], 1 inside the scope's circular image. Pixels outside are never tissue. None without such a
    file.
    """
    depth: DepthFiles | None = None
    labels: LabelFiles | None = None
    """Files with a class for each pixel of some frames; None without them."""
    scans: ScanFiles | None = None
    """Scans of a range sensor at some frames; None without them."""
    tool_share: float | None = None
    stereo_baseline_mm: float | None = None
    rectification: Rectification | None = None
    """Rectification of both eyes; `calibration` is then that of the rectified left camera. None if the pictures are used
    as they are.
    """
    undistortion: Undistortion | None = None
    """Maps of a distorted lens; `calibration` is then that of the camera without distortion. None if no map is used."""
    other_files: tuple[Path, ...] = ()
    """Further files of the recording, with its calibration and description."""

    @property
    def fields(self) -> frozenset[str]:
        """Optional fields that every frame has; of `labels` and `ranges`, that some frames have."""
        has = {
            "right_image": self.right is not None,
            "depth": self.depth is not None,
            "mask": self.masks is not None or self.valid_mask is not None,
            "pose": self.calibration.poses is not None,
            "labels": self.labels is not None,
            "ranges": self.scans is not None,
        }
        return frozenset(name for name, there in has.items() if there)

    @cached_property
    def right_camera(self) -> Camera | None:
        """Camera of the right eye, as in `Frame`; None without right eye or known baseline."""
        if self.right is None or self.stereo_baseline_mm is None:
            return None
        if self.rectification is not None:
            return self.rectification.right_camera
        return self.calibration.camera.right_eye(self.stereo_baseline_mm)

    def frames(self, findings: Findings, limit: int | None = None) -> Generator[Frame | None, None, None]:
        """Yield frames at full size, decoded on demand; None for a frame with a problem.

        A background thread reads the sidecars a few frames ahead while the caller's thread decodes the images.

        Args:
            findings: collector of problems and warnings.
            limit: number of frames to read; None reads all.
        """
        pictures = islice(self.images.frames(findings), limit)
        with closing(self._beside()) as beside:
            for index, (picture, found) in enumerate(zip(pictures, beside, strict=False)):
                findings.add(found.found)
                if picture is None or found.found.problems:
                    yield None
                    continue
                yield self._frame(index, picture, found)

    def _beside(self) -> Generator[_Beside, None, None]:
        """Return an iterator over the sidecar data of each image (mask, depth, right eye, labels, scan)."""
        if not any((self.right, self.masks, self.depth, self.labels, self.scans)):
            return (_Beside() for _ in range(self.images.frame_count))
        return read_ahead(self._read_beside(), f"read what lies beside the images of {printable(self.root.name)}")

    def _read_beside(self) -> Generator[_Beside, None, None]:
        # Collect the findings of each frame separately, because the read-ahead thread reads frames before they are
        # yielded.
        found = Findings()
        rights = self.right.frames(found) if self.right else None
        for index in range(self.images.frame_count):
            right = next(rights, None) if rights else None
            depth = self.depth.read(index, found) if self.depth else None
            mask = self.masks.read(index, found) if self.masks else None
            labels = self.labels.read(index, found) if self.labels else None
            scan = self.scans.read(index, found) if self.scans else None
            yield _Beside(right, depth, mask, labels, scan, found.taken())

    def _frame(self, index: int, picture: Picture, beside: _Beside) -> Frame:
        right, depth, mask, labels = beside.right, beside.depth, beside.mask, beside.labels
        damage = picture.damage or (right.damage if right else None)
        if damage is not None:
            # No pixel is known to be tissue, so training and scoring skip the frame.
            mask = np.zeros(picture.image.shape[:2], np.uint8)
        elif self.valid_mask is not None:
            mask = self.valid_mask if mask is None else mask & self.valid_mask
        poses, times = self.calibration.poses, self.images.times
        image, other, outside = picture.image, None if right is None else right.image, None
        if self.rectification is not None:
            image, outside = self.rectification.left(image), self.rectification.inside
            other = None if other is None else self.rectification.right(other)
            mask = None if mask is None else self.rectification.plane(mask)
            labels = None if labels is None else _mapped_labels(labels, self.rectification.plane)
        if self.undistortion is not None:
            image, outside = self.undistortion.picture(image), self.undistortion.inside
            mask = None if mask is None else self.undistortion.plane(mask)
            depth = None if depth is None else self.undistortion.depth(depth)
            labels = None if labels is None else _mapped_labels(labels, self.undistortion.plane)
        return Frame(
            seq=index,
            pts_ns=round((index if times is None else times[index]) * 1e9 / self.fps),
            image=image,
            right_image=other,
            right_camera=self.right_camera,
            depth=depth,
            mask=mask,
            labels=labels,
            ranges=beside.scan,
            loss_mask=outside,
            pose=None if poses is None else poses[index],
            status=FrameStatus.REPLAY if damage is None else FrameStatus.DAMAGED,
            damage=damage,
        )

    def files(self) -> list[Path]:
        """Return every file that is read, sorted."""
        parts = (self.images, self.right, self.masks, self.depth, self.labels, self.scans)
        return sorted({*self.other_files, *(path for part in parts if part for path in part.files)})

    def digest(self) -> str:
        """Return the digest of all files; see `digest_of`."""
        return digest_of(self.root, self.files())


def _mapped_labels(
    labels: NDArray[np.uint8], plane: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    """Return labels that were moved by a map whose pixels outside are 0; they become 255 (unknown)."""
    return plane(labels + np.uint8(1)) - np.uint8(1)


def digest_of(root: Path, files: Sequence[Path]) -> str:
    """Return the sha256 over name, length and bytes of each file, in order.

    Names are relative to `root`.

    Raises:
        RecordingInvalid: if a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in files:
        name = path.relative_to(root).as_posix() if path != root else path.name
        try:
            with open_plain(path) as stream:
                digest.update(os.fsencode(name) + f"\0{os.fstat(stream.fileno()).st_size}\0".encode())
                while block := stream.read(1 << 20):
                    digest.update(block)
        except (UnreadableFile, OSError) as error:
            raise RecordingInvalid(
                f"{printable(path)}: {error}. Leave the recording alone while it is read."
            ) from error
    return digest.hexdigest()
