"""Contents of a recording independent of its layout: images, cameras and optional sidecars.

Sidecars are masks, depth, labels, scans of range sensors, the right eye, poses, and the description of the recording.

A sidecar is absent if no entry has its name. An entry with its name that cannot be used is a problem: a file in place of a
folder, a dangling link, a link out of the recording, or an empty folder. Ignoring a broken mask would let tools be learned as
tissue.

A thread reads ahead: it produces the next frames while the current one is processed.
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
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings.calibration import (
    POSES_FILE,
    Calibration,
    Rectification,
    Undistortion,
    number,
    read_distortion,
    read_json,
    read_pinhole,
    read_poses,
    read_poses_bounds,
)
from gsplat_core.io.recordings.frame_files import (
    SENSOR_FILE,
    DepthFiles,
    ImageFiles,
    LabelFiles,
    MaskFiles,
    ScanFiles,
    by_frame,
    check_pairing,
    check_sizes,
    read_sensor,
)
from gsplat_core.io.recordings.plain_files import (
    IMAGE_SUFFIXES,
    Findings,
    Picture,
    UnreadableFile,
    all_stay_inside,
    decode_plane,
    list_images,
    open_plain,
    printable,
    stays_inside,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame, FrameStatus
from gsplat_core.scene.range_sensors import RangeScan


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
    keeps_times: bool
    """True if `times` come from the file and are not scaled to a frame rate that `recording.json` states."""

    def frames(self, findings: Findings) -> Iterator[Picture | None]:
        """Yield the pictures in order; None for one that cannot be read at all."""
        ...


class _SidecarData(NamedTuple):
    """Sidecar data of one image, and the problems found in them."""

    right: Picture | None = None
    depth: NDArray[np.float32] | None = None
    mask: NDArray[np.uint8] | None = None
    labels: NDArray[np.uint8] | None = None
    scan: RangeScan | None = None
    found: Findings = Findings()


@dataclass(frozen=True)
class Contents:
    """Files and calibration of a recording that passed all checks except full decoding, and the reading of its frames."""

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
    """Further files of the recording, including those with its calibration and description."""

    @property
    def fields(self) -> frozenset[str]:
        """Names of the optional frame fields that are present: on every frame or, for `labels` and `ranges`, on some frames."""
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

    def _beside(self) -> Generator[_SidecarData, None, None]:
        """Return an iterator over the sidecar data of each image (mask, depth, right eye, labels, scan)."""
        if not any((self.right, self.masks, self.depth, self.labels, self.scans)):
            return (_SidecarData() for _ in range(self.images.frame_count))
        return read_ahead(self._read_beside(), f"read what lies beside the images of {printable(self.root.name)}")

    def _read_beside(self) -> Generator[_SidecarData, None, None]:
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
            yield _SidecarData(right, depth, mask, labels, scan, found.taken())

    def _frame(self, index: int, picture: Picture, beside: _SidecarData) -> Frame:
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
    """Return the labels undistorted or rectified by `plane`. Pixels outside of the original picture become 255 (unknown)."""
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


RECORDING_FORMAT = "intrasplat-recording"
RECORDING_VERSION = 1
DESCRIPTION_FILE = "recording.json"
_FILES = (DESCRIPTION_FILE, POSES_FILE, "poses_bounds.npy", "cameras.json", "valid_mask.png")


class Beside:
    """Reader of the sidecar files in a recording's folder. With `folder=None` it finds none."""

    def __init__(self, folder: Path | None, images: FrameImages, findings: Findings) -> None:
        self._folder = folder
        self._images = images
        self._size = (images.width_px, images.height_px)
        self._findings = findings

    def files(self) -> tuple[Path, ...]:
        """Paths of the existing sidecars that consist of a single file."""
        found = (self._file(name) for name in _FILES)
        return tuple(path for path in found if path is not None)

    def description(self) -> dict[str, Any]:
        """Read fps, camera, depth_unit_mm and stereo_baseline_mm of `recording.json`, each optional."""
        path = self._file(DESCRIPTION_FILE)
        return (_read_description(path, self._size, self._findings) if path else None) or {}

    def poses(self) -> Calibration | None:
        """Return the calibration stored in `poses_bounds.npy`; None without the file or after a problem."""
        path = self._file("poses_bounds.npy")
        return read_poses_bounds(path, self._images.frame_count, *self._size, self._findings) if path else None

    def poses_alone(self) -> NDArray[np.float64] | None:
        """Return the world-to-camera poses [N, 4, 4] of `poses.npy`; None if it is missing or has a problem."""
        path = self._file(POSES_FILE)
        return read_poses(path, self._images.frame_count, self._findings) if path else None

    def right(self) -> ImageFiles | None:
        """Return the reader of the right eye's images; None without them or after a problem."""
        files = self._sequence("images_right", "right image")
        return ImageFiles(files, *self._size) if files else None

    def masks(self) -> MaskFiles | None:
        """Return the reader of the tool masks; None without masks or after a problem."""
        files = self._sequence("masks", "mask")
        return MaskFiles(files) if files else None

    def depth(self, unit_mm: float | None) -> DepthFiles | None:
        """Return the reader of the depth maps; None without them or after a problem. `unit_mm` is the length of one grey
        value; None if not stated, which counts as 1 mm."""
        files = self._sequence("depth", "depth map")
        if not files:
            return None
        if unit_mm is None:
            unit_mm = 1.0
            if any(path.suffix.lower() != ".npy" for path in files):
                self._findings.warn(
                    files[0].parent, "the unit of depth is not stated", "1 mm for each grey value is assumed"
                )
        return DepthFiles(files, *self._size, unit_mm)

    def labels(self) -> LabelFiles | None:
        """Return the reader of the labelled frames' classes; None without labels or after a problem."""
        found = self._some("labels", "label picture", IMAGE_SUFFIXES)
        if not found or check_sizes(list(found.values()), self._size, "label picture", self._findings) is None:
            return None
        return LabelFiles(found)

    def scans(self) -> ScanFiles | None:
        """Return the reader of the scans of a range sensor; None without scans or after a problem."""
        found = self._some("scans", "scan", frozenset({".npy"}))
        if not found:
            return None
        path = next(iter(found.values())).parent / SENSOR_FILE
        if not stays_inside(path.parent, path, self._findings):
            return None
        sensor = read_sensor(path, self._findings)
        return None if sensor is None else ScanFiles(found, sensor, self._size[0], path)

    def valid_mask(self) -> NDArray[np.uint8] | None:
        """Read the mask [H, W] of the scope's circular image, 1 inside; None without a usable file."""
        path = self._file("valid_mask.png")
        return _read_valid_mask(path, self._size, self._findings) if path else None

    def _file(self, name: str) -> Path | None:
        """Return an existing file, else None; a link that dangles or leads outside is reported as a problem."""
        path = self._there(name)
        return path if path is not None and stays_inside(path.parent, path, self._findings) else None

    def _there(self, name: str) -> Path | None:
        if self._folder is None or not os.path.lexists(self._folder / name):
            return None
        return self._folder / name

    def _some(self, name: str, what: str, suffixes: frozenset[str]) -> dict[int, Path] | None:
        """Return the files of a folder with a file for some of the frames, by index of the frame; None without
        the folder or after a problem.
        """
        folder = self._there(name)
        if folder is None or not stays_inside(folder.parent, folder, self._findings):
            return None
        if not folder.is_dir():
            self._findings.problem(
                folder, "it is not a folder", f"Give a folder with a {what} for some frames, or remove it"
            )
            return None
        files = list_images(folder, suffixes)
        if not all_stay_inside(folder.parent, files, self._findings):
            return None
        return by_frame(self._images.numbers, files, folder, what, self._findings)

    def _sequence(self, name: str, what: str) -> Sequence[Path] | None:
        """Return the files of a folder with one file per frame; None without the folder or after a problem."""
        folder = self._there(name)
        if folder is None or not stays_inside(folder.parent, folder, self._findings):
            return None
        if not folder.is_dir():
            self._findings.problem(
                folder, "it is not a folder", f"Give a folder with one {what} for each frame, or remove it"
            )
            return None
        files = list_images(folder)
        if what == "depth map" and not files:
            files = list_images(folder, frozenset({".npy"}))
        if not check_pairing(self._images.numbers, files, folder, what, self._findings):
            return None
        if not all_stay_inside(folder.parent, files, self._findings):
            return None
        return files if check_sizes(files, self._size, what, self._findings) else None


def _read_valid_mask(path: Path, size: tuple[int, int], findings: Findings) -> np.ndarray | None:
    try:
        mask = decode_plane(path)
    except UnreadableFile as error:
        findings.problem(path, str(error), "Export this mask again")
        return None
    if mask.shape != (size[1], size[0]):
        findings.problem(
            path,
            f"the mask is {list(mask.shape)}, the images are {[size[1], size[0]]}",
            "Give a grey PNG of their size",
        )
        return None
    values = np.unique(mask)
    if len(values) > 2 or values[-1] not in (0, 1, 255):
        findings.problem(
            path,
            f"it has {len(values)} different values, up to {values[-1]}",
            "Give two: 0 outside the scope's circle, 255 (or 1) inside",
        )
        return None
    if not mask.any():
        findings.problem(path, "it marks no pixel as valid", "255 means inside the scope's circle")
        return None
    return (mask != 0).astype(np.uint8)


def _read_description(path: Path, size: tuple[int, int], findings: Findings) -> dict[str, Any] | None:
    """Read the values of `Beside.description` from `recording.json`. Returns None if the file is invalid."""
    if (content := read_json(path, findings)) is None:
        return None
    if content.get("format") != RECORDING_FORMAT or content.get("version") != RECORDING_VERSION:
        findings.problem(
            path,
            f"format {content.get('format')!r:.60} version {content.get('version')!r:.20} is not known",
            f"This version reads {RECORDING_FORMAT} {RECORDING_VERSION}",
        )
        return None
    read: dict[str, Any] = {}
    for key, low, high in (("fps", 0.1, 1000), ("depth_unit_mm", 1e-6, 1e3), ("stereo_baseline_mm", 1e-3, 1e4)):
        if content.get(key) is not None:
            value = number(content[key])
            if value is None or not low <= value <= high:
                findings.problem(path, f"{key} is {content[key]!r:.40}", f"Give a number from {low:g} to {high:g}")
                return None
            read[key] = value
    if (described := content.get("camera")) is not None:
        if not isinstance(described, dict):
            findings.problem(path, f"camera is {described!r:.40}", "Give width, height, fx, fy, cx and cy in pixels")
            return None
        camera, distortion = read_pinhole(path, described, findings), read_distortion(path, described, findings)
        if camera is not None and (camera.width_px, camera.height_px) != size:
            findings.problem(
                path,
                f"its camera is {camera.width_px}x{camera.height_px}, the images are {size[0]}x{size[1]}",
                "Give the camera of these images",
            )
        read |= {"camera": camera, "distortion": distortion or ()}
    return read


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
        """Yield the items in the consumer's thread; at the end raise the exception of the producing thread, if any."""
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
