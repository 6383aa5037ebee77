"""Reader of scenes in COLMAP's format: cameras, posed images and points, as `.bin` or `.txt`.

A scene is a folder with `images/` and a reconstruction in `sparse/0/`, `sparse/` or the folder itself. Lens models with
distortion are refused; COLMAP's `image_undistorter` removes it. COLMAP's poses map world to camera, in the camera's
axes x right, y down, z forward. The centre of the first pixel is at (0.5, 0.5), as in `Camera`.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidSetting, RecordingInvalid, RecordingMissing
from gsplat_core.io.files import open_regular
from gsplat_core.io.recordings.plain_files import UnreadableFile, decode_picture
from gsplat_core.scene.cameras import MAX_INTRINSICS_PX, MIN_FOCAL_PX, Camera

MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
}  # fmt: skip
"""Name and number of parameters of COLMAP's lens models by number."""
PLACES = (Path("sparse/0"), Path("sparse"), Path("."))
MOST_NAME_BYTES = 4096
MOST_SIDE_PX = 1 << 16
MOST_TRANSLATION = 1e9
SAME_SHAPE = 0.01
"""Largest relative difference of the aspect ratios of a camera and its image file."""
HELD_OUT_EVERY = 8
"""Default interval of held-out images: the first image, and every eighth after it."""


@dataclass(frozen=True)
class PosedImage:
    """Image of a static scene, with its camera."""

    name: str
    """Path of the image inside `images/`."""
    camera: Camera
    """Camera of the image at the size that COLMAP states, which may differ from that of the file."""


@dataclass(frozen=True)
class ColmapScene:
    """Posed images of a scene, sorted by name."""

    folder: Path
    sparse: Path
    """Folder of COLMAP's reconstruction: the files of cameras, images and points."""
    images: tuple[PosedImage, ...]

    def held_out(self, every: int = HELD_OUT_EVERY) -> tuple[PosedImage, ...]:
        """Return every k-th image, beginning with the first: the usual test split of 3DGS trainers."""
        return self.images[::every]

    def training(self, every: int = HELD_OUT_EVERY) -> tuple[PosedImage, ...]:
        """Return the images that are not held out."""
        return tuple(posed for number, posed in enumerate(self.images) if number % every)

    def read(self, posed: PosedImage, images: str = "images", scale: float = 1.0) -> tuple[Camera, NDArray[np.uint8]]:
        """Read an image, and return it with the camera for its size.

        Args:
            posed: image of this scene.
            images: folder of the image files inside the scene, such as `images_4` for smaller ones.
            scale: factor on the size of the image.

        Returns:
            Camera, and RGB [H, W, 3].

        Raises:
            RecordingInvalid: if the file is missing or damaged, or its aspect ratio differs from that of the camera.
            InvalidSetting: if nothing is left of the image at `scale`.
        """
        path = self.folder / images / posed.name
        try:
            picture = decode_picture(path)
        except UnreadableFile as error:
            raise RecordingInvalid(f"{path}: {error}; copy the image again, or give another --images") from error
        if picture.damage is not None:
            raise RecordingInvalid(f"{path} is damaged: {picture.damage}; copy the image again")
        image = picture.image
        height_px, width_px = image.shape[:2]
        if min(width_px, height_px) * scale < 1:
            raise InvalidSetting(
                f"at scale {scale:g} nothing is left of {width_px}x{height_px} px; give at least {1 / min(width_px, height_px):.3g}"
            )
        if scale != 1:
            width_px, height_px = max(1, round(width_px * scale)), max(1, round(height_px * scale))
            image = np.asarray(cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)
        camera = posed.camera
        ratio = width_px / height_px / (camera.width_px / camera.height_px)
        if abs(ratio - 1) > SAME_SHAPE + 1 / min(width_px, height_px):
            raise RecordingInvalid(
                f"{posed.name} has {width_px}x{height_px} px and its camera {camera.width_px}x{camera.height_px} px, which is another shape"
            )
        return camera.resized(width_px, height_px), image

    def points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Read the points of the reconstruction.

        Returns:
            Positions [N, 3] and colours [N, 3].

        Raises:
            RecordingError: if the file is missing or malformed.
        """
        path = _found(self.sparse, "points3D")
        rows = list(_points_of_text(path) if path.suffix == ".txt" else _points_of_binary(path))
        table = np.array(rows, np.float64).reshape(-1, 6)
        if not np.isfinite(table).all() or np.abs(table[:, :3]).max(initial=0) > MOST_TRANSLATION:
            raise RecordingInvalid(
                f"{path} holds points that are NaN, infinite or beyond {MOST_TRANSLATION:g}; export the scene again"
            )
        return table[:, :3], np.clip(table[:, 3:], 0, 255).astype(np.uint8)


def read_colmap(folder: Path) -> ColmapScene:
    """Read the cameras and poses of a scene.

    Raises:
        RecordingMissing: if the folder has no reconstruction.
        RecordingInvalid: if a file is malformed, or a lens model is neither SIMPLE_PINHOLE nor PINHOLE.
    """
    sparse = _sparse_folder(folder)
    path = _found(sparse, "cameras")
    cameras: dict[int, Camera] = {}
    for number, camera in _cameras_of_text(path) if path.suffix == ".txt" else _cameras_of_binary(path):
        if number in cameras:
            raise RecordingInvalid(f"{path} defines camera {number} twice; export the scene again")
        cameras[number] = camera
    path = _found(sparse, "images")
    images: dict[str, PosedImage] = {}
    for number, pose, camera_number, name in (
        _images_of_text(path) if path.suffix == ".txt" else _images_of_binary(path)
    ):
        if camera_number not in cameras:
            raise RecordingInvalid(f"{path}: image {number} has camera {camera_number}, which {sparse} does not define")
        if name in images:
            raise RecordingInvalid(f"{path} has the image {name!r:.80} twice; export the scene again")
        if not name or name.startswith(("/", "\\")) or ".." in Path(name).parts or "\0" in name:
            raise RecordingInvalid(f"{path}: image {number} is named {name!r:.80}, which is not inside images/")
        images[name] = PosedImage(name, cameras[camera_number].with_pose(_matrix(path, number, pose)))
    if not images:
        raise RecordingInvalid(f"{path} has no images; give a scene with registered images")
    return ColmapScene(folder, sparse, tuple(sorted(images.values(), key=lambda each: each.name)))


def _sparse_folder(folder: Path) -> Path:
    for place in PLACES:
        if any((folder / place / f"cameras{suffix}").exists() for suffix in (".bin", ".txt")):
            return folder / place
    raise RecordingMissing(
        f"{folder} is no scene of COLMAP: it has no cameras.bin or cameras.txt in sparse/0, sparse or itself"
    )


def _found(sparse: Path, name: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (sparse / f"{name}{suffix}").exists():
            return sparse / f"{name}{suffix}"
    raise RecordingMissing(f"{sparse} has no {name}.bin or {name}.txt; export the scene again")


def _matrix(path: Path, number: int, pose: tuple[float, ...]) -> NDArray[np.float64]:
    """Return world to camera [4, 4] of a quaternion wxyz and a translation."""
    w, x, y, z, *translation = pose
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not (all(abs(value) < MOST_TRANSLATION for value in pose) and 1e-6 < length < 1e6):
        raise RecordingInvalid(f"{path}: image {number} has the pose {pose}, which is no rotation and translation")
    w, x, y, z = w / length, x / length, y / length, z / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix


def _camera(path: Path, number: int, model: str, width_px: int, height_px: int, values: list[float]) -> Camera:
    if model not in ("SIMPLE_PINHOLE", "PINHOLE"):
        raise RecordingInvalid(
            f"{path}: camera {number} has the lens model {model[:40]}, and only SIMPLE_PINHOLE and PINHOLE are read; undistort the images with COLMAP's image_undistorter"
        )
    wanted = 3 if model == "SIMPLE_PINHOLE" else 4
    if len(values) != wanted or not (0 < width_px <= MOST_SIDE_PX and 0 < height_px <= MOST_SIDE_PX):
        raise RecordingInvalid(
            f"{path}: camera {number} has {len(values)} parameters and {width_px}x{height_px} px; {model} has {wanted}, and a side at most {MOST_SIDE_PX}"
        )
    if not all(abs(value) < MAX_INTRINSICS_PX for value in values):
        raise RecordingInvalid(
            f"{path}: camera {number} has the parameters {values}; they must be below {MAX_INTRINSICS_PX:g} px"
        )
    fx, fy, cx, cy = values if wanted == 4 else (values[0], *values)
    if min(fx, fy) < MIN_FOCAL_PX:
        raise RecordingInvalid(
            f"{path}: camera {number} has the focal lengths {fx:g} and {fy:g} px; they must be at least {MIN_FOCAL_PX:g} px"
        )
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), width_px, height_px)


class _Binary:
    """Reader of little-endian values; every error names the file."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self.path = file, path
        self.size = os.fstat(file.fileno()).st_size

    def take(self, layout: str) -> tuple[float, ...]:
        """Read the values of a `struct` format. Raises RecordingInvalid at the end of the file."""
        size = struct.calcsize(layout)
        data = self._file.read(size)
        if len(data) < size:
            raise self._short()
        return struct.unpack(layout, data)

    def count(self, least_bytes: int) -> int:
        """Read a number of entries. Raises RecordingInvalid if so many, of `least_bytes` each, do not fit into the file."""
        (found,) = self.take("<Q")
        if found * least_bytes > self.size:
            raise self._short(f": {found} entries do not fit into its {self.size} bytes")
        return int(found)

    def skip(self, size: int) -> None:
        """Skip bytes. Raises RecordingInvalid beyond the end of the file."""
        if self._file.seek(size, os.SEEK_CUR) > self.size:
            raise self._short()

    def text(self) -> str:
        """Read a text that ends with a zero byte."""
        data = bytearray()
        while byte := self._file.read(1):
            if byte == b"\0":
                return data.decode("utf-8", "replace")
            data += byte
            if len(data) > MOST_NAME_BYTES:
                break
        raise self._short()

    def _short(self, why: str = "") -> RecordingInvalid:
        return RecordingInvalid(f"{self.path} is cut short or is no file of COLMAP{why}; export the scene again")


def _open(path: Path) -> BinaryIO:
    try:
        return open_regular(path)
    except OSError as error:
        raise RecordingInvalid(f"{path} cannot be read: {error.strerror or error}") from error


def _cameras_of_binary(path: Path) -> Iterator[tuple[int, Camera]]:
    with _open(path) as file:
        reader = _Binary(file, path)
        for _ in range(reader.count(24)):
            number, model, width_px, height_px = (int(value) for value in reader.take("<iiQQ"))
            name, parameters = MODELS.get(model, (f"number {model}", 0))
            values = list(reader.take(f"<{parameters}d"))
            yield number, _camera(path, number, name, width_px, height_px, values)


def _images_of_binary(path: Path) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    with _open(path) as file:
        reader = _Binary(file, path)
        for _ in range(reader.count(64)):
            (number,) = reader.take("<i")
            pose = reader.take("<7d")
            (camera,) = reader.take("<i")
            name = reader.text()
            reader.skip(24 * reader.count(24))
            yield int(number), pose, int(camera), name


def _points_of_binary(path: Path) -> Iterator[tuple[float, ...]]:
    with _open(path) as file:
        reader = _Binary(file, path)
        for _ in range(reader.count(51)):
            values = reader.take("<Q3d3Bd")
            reader.skip(8 * reader.count(8))
            yield values[1:7]


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file without comments, with their numbers. Empty lines are kept."""
    with _open(path) as file:
        for number, line in enumerate(file, 1):
            text = line.decode("utf-8", "replace").strip()
            if not text.startswith("#"):
                yield number, text


def _malformed(path: Path, line: int, text: str) -> RecordingInvalid:
    return RecordingInvalid(f"{path}: line {line} cannot be read: {text[:80]!r}; export the scene again")


def _cameras_of_text(path: Path) -> Iterator[tuple[int, Camera]]:
    for line, text in _lines(path):
        if not text:
            continue
        try:
            number, model, width_px, height_px, *values = text.split()
            parsed = int(number), model, int(width_px), int(height_px), [float(value) for value in values]
        except ValueError as error:
            raise _malformed(path, line, text) from error
        yield parsed[0], _camera(path, *parsed)


def _images_of_text(path: Path) -> Iterator[tuple[int, tuple[float, ...], int, str]]:
    is_points = False  # every second line, which may be empty, lists an image's points
    for line, text in _lines(path):
        if is_points or not text:
            if text and not _lists_points(text):
                raise RecordingInvalid(
                    f"{path}: line {line} lists no points of the image in the line before: {text[:80]!r}; after each image, a"
                    " line with its points is needed, which may be empty"
                )
            is_points = False
            continue
        is_points = True
        try:
            number, *pose, camera, name = text.split(maxsplit=9)
            parsed = int(number), tuple(float(value) for value in pose), int(camera), name
        except ValueError as error:
            raise _malformed(path, line, text) from error
        if len(parsed[1]) != 7:
            raise _malformed(path, line, text)
        yield parsed


def _lists_points(text: str) -> bool:
    """Return True if the text has three numbers for each point, judged by their count and the last one."""
    values = text.split()
    try:
        float(values[-1])
    except ValueError:
        return False
    return len(values) % 3 == 0


def _points_of_text(path: Path) -> Iterator[tuple[float, ...]]:
    for line, text in _lines(path):
        if not text:
            continue
        try:
            values = tuple(float(value) for value in text.split()[1:7])
        except ValueError as error:
            raise _malformed(path, line, text) from error
        if len(values) != 6:
            raise _malformed(path, line, text)
        yield values
