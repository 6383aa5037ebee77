"""Calibrations of a pair of eyes, in the files that data sets and calibration programs write.

| file                                                     | written by                                             |
|----------------------------------------------------------|--------------------------------------------------------|
| `calibration.m`                                          | SCARED: a MATLAB function that holds the numbers       |
| `calibration.json`                                       | SCARED: `camera-calibration` with KL, KR, DL, DR, R, T |
| `StereoCalibration.ini`                                  | StereoMIS, da Vinci: StereoLeft and StereoRight        |
| `calib.left.intrinsic.txt`, `…right…`, `calib.l2r.4x4`   | Hamlyn, scikit-surgery                                 |
| `stereo_calibration.yaml`, `endoscope_calibration.yaml`  | OpenCV: M1, D1, M2, D2, R, T                           |

None of them is run or given to a parser that does more than read numbers.
"""

from __future__ import annotations

import configparser
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput
from gsplat_core.geometry.rectification import Rectification, StereoCalibration
from gsplat_core.io.recordings.calibration import Calibration, read_json
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.plain_files import UnreadableFile, open_plain, stays_inside

MAX_BYTES = 1 << 20
Numbers = NDArray[np.float64]
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_ADVICE = "docs/recordings.md has the layouts; correct the file, or remove it"


class _Unusable(Exception):
    """Why the numbers cannot be found."""


def read_stereo_calibration(folder: Path, findings: Findings) -> tuple[StereoCalibration, tuple[Path, ...]] | None:
    """The calibration in a recording's folder and the files that it was read from; None where there is none, or it has a problem."""
    for names, read in _LAYOUTS.items():
        paths = tuple(folder / name for name in names)
        if not paths[0].is_file():
            continue
        if not all(stays_inside(folder, path, findings) for path in paths):
            return None
        try:
            calibration = read(paths, findings)
        except (_Unusable, UnreadableFile, ValueError) as error:
            findings.problem(paths[0], f"it gives no calibration of two eyes: {error!s:.200}", _ADVICE)
            return None
        if calibration is None:
            return None
        why = calibration.wrong()
        if why is not None:
            findings.problem(paths[0], why, _ADVICE)
            return None
        return calibration, paths
    return None


@dataclass(frozen=True)
class RectifiedBy:
    """How a recording's pair is rectified, and its left camera then."""

    by: Rectification
    calibration: Calibration
    files: tuple[Path, ...]
    baseline_mm: float


def rectified_by_file(
    folder: Path, size: tuple[int, int], calibration: Calibration | None, findings: Findings
) -> RectifiedBy | None:
    """The rectification of a recording by the file in its folder. calibration: what is known of its left camera without it; the poses of the
    camera are turned with it."""
    read = read_stereo_calibration(folder, findings)
    if read is None:
        return None
    try:
        by = Rectification(read[0], *size)
    except InvalidInput as error:
        findings.problem(folder, str(error), _ADVICE)
        return None
    poses = None if calibration is None or calibration.poses is None else by.turn @ calibration.poses
    camera = by.left_camera if poses is None else by.left_camera.with_pose(poses[0])
    left = Calibration(camera, poses, read[0].source)
    return RectifiedBy(by, left, read[1], -float(by.right_camera.world_to_camera[0, 3]))


def _text(path: Path) -> str:
    with open_plain(path) as stream:
        data = stream.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise _Unusable(f"it has more than {MAX_BYTES} bytes")
    return data.decode("utf-8", "replace")


def _shaped(numbers: Sequence[float] | Any, shape: tuple[int, ...], name: str) -> Numbers:
    found = np.array(numbers, dtype=np.float64).ravel()
    if found.size != int(np.prod(shape)):
        raise _Unusable(f"{name} has {found.size} numbers in place of {int(np.prod(shape))}")
    return found.reshape(shape)


def _distortion(numbers: Sequence[float] | Any, name: str) -> Numbers:
    found = np.array(numbers, dtype=np.float64).ravel()
    if found.size > 8:
        if np.any(found[8:]):
            raise _Unusable(f"{name} has {found.size} numbers; up to 8 are understood")
        found = found[:8]
    # The next length that OpenCV knows.
    return np.pad(found, (0, next(length for length in (4, 5, 8) if length >= found.size) - found.size))


def _numbers(text: str) -> list[float]:
    return [float(each) for each in _NUMBER.findall(text)]


def _matlab(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    text = "\n".join(line.partition("%")[0] for line in _text(paths[0]).splitlines())

    def value(name: str, *, optional: bool = False) -> list[float]:
        found = re.search(rf"\b{name}\s*=[^\[\];]*\[([^\]]*)\]", text)
        if found is None and not optional:
            raise _Unusable(f"there is no {name} = [...]")
        return _numbers(found[1]) if found else []

    def eye(side: str) -> tuple[Numbers, Numbers]:
        radial, tangential = value(f"radialDistortion{side}"), value(f"tangentialDistortion{side}", optional=True)
        first, rest = radial[:2], radial[2:3]
        return _shaped(value(f"IntrinsicMatrix{side}"), (3, 3), "IntrinsicMatrix"), _distortion(
            [*first, *(tangential or [0.0, 0.0]), *rest], "radialDistortion"
        )

    left, right = eye("Left"), eye("Right")
    # All matrices are OpenCV's. The function transposes the intrinsics for MATLAB and not the rotation; the pictures agree with the rotation as it
    # is written: rows of `scared_raw` are off by 0.40 px with it, by 0.69 px with its transpose.
    rotation = _shaped(value("rotationOfCameraMatrix"), (3, 3), "rotationOfCameraMatrix")
    translation = _shaped(value("translationOfCameraMatrix"), (3,), "translationOfCameraMatrix")
    return StereoCalibration(*left, *right, rotation, translation, paths[0].name)


def _scared_json(paths: Sequence[Path], findings: Findings) -> StereoCalibration | None:
    content = read_json(paths[0], findings)
    if content is None:
        return None
    inside = content.get("camera-calibration", content)
    if not isinstance(inside, dict):
        raise _Unusable("camera-calibration is no object")
    return _from_matrices({str(name): value for name, value in inside.items()}, paths[0].name)


_MATRIX = re.compile(r"(\w+)\s*:\s*!!opencv-matrix\s+rows:\s*\d+\s+cols:\s*\d+\s+dt:\s*\S+\s+data:\s*\[([^\]]*)\]")
_NAMES = {
    "left_K": ("M1", "K1", "KL", "cameraMatrix1"), "left_distortion": ("D1", "DL", "distCoeffs1"),
    "right_K": ("M2", "K2", "KR", "cameraMatrix2"), "right_distortion": ("D2", "DR", "distCoeffs2"),
    "rotation": ("R",), "translation_mm": ("T",),
}  # fmt: skip


def _opencv_yaml(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    found = {name: _numbers(data) for name, data in _MATRIX.findall(_text(paths[0]))}
    return _from_matrices(found, paths[0].name)


def _from_matrices(found: dict[str, Any], source: str) -> StereoCalibration:
    values: dict[str, Any] = {}
    for wanted, names in _NAMES.items():
        there = [name for name in names if name in found]
        if not there:
            raise _Unusable(f"there is no {' or '.join(names)}")
        numbers = found[there[0]]
        if wanted.endswith("distortion"):
            values[wanted] = _distortion(numbers, there[0])
        else:
            values[wanted] = _shaped(numbers, (3,) if wanted == "translation_mm" else (3, 3), there[0])
    return StereoCalibration(**values, source=source)


def _ini(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(_text(paths[0]))
        left, right = parser["StereoLeft"], parser["StereoRight"]

        def value(section: configparser.SectionProxy, name: str) -> float:
            return float(section[name])

        def eye(section: configparser.SectionProxy) -> tuple[Numbers, Numbers]:
            fx, fy, cx, cy = (value(section, name) for name in ("fc_x", "fc_y", "cc_x", "cc_y"))
            lens = [value(section, f"kc_{i}") for i in range(8) if f"kc_{i}" in section]
            return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), _distortion(lens, "kc")

        size = int(value(left, "res_x")), int(value(left, "res_y"))
        rotation = _shaped([value(right, f"R_{i}") for i in range(9)], (3, 3), "R")
        translation = _shaped([value(right, f"T_{i}") for i in range(3)], (3,), "T")
        return StereoCalibration(*eye(left), *eye(right), rotation, translation, paths[0].name, size)
    except (configparser.Error, KeyError) as error:
        raise _Unusable(f"there is no {error}") from error


def _hamlyn(paths: Sequence[Path], findings: Findings) -> StereoCalibration:
    between, left, right = (_numbers(_text(path)) for path in paths)
    pose = _shaped(between, (4, 4), "the transform from left to right")

    def eye(numbers: list[float], name: str) -> tuple[Numbers, Numbers]:
        return _shaped(numbers[:9], (3, 3), name), _distortion(numbers[9:], name)

    return StereoCalibration(
        *eye(left, "the left intrinsics"), *eye(right, "the right intrinsics"), pose[:3, :3], pose[:3, 3], paths[0].name
    )


_Reader = Callable[[Sequence[Path], Findings], StereoCalibration | None]
_LAYOUTS: dict[tuple[str, ...], _Reader] = {
    ("calibration.m",): _matlab,
    ("calibration.json",): _scared_json,
    ("StereoCalibration.ini",): _ini,
    ("calib.l2r.4x4", "calib.left.intrinsic.txt", "calib.right.intrinsic.txt"): _hamlyn,
    **{
        (f"{name}{suffix}",): _opencv_yaml
        for name in ("stereo_calibration", "endoscope_calibration")
        for suffix in (".yaml", ".yml")
    },
}
