"""Recognition of a recording's layout by the files in its folder.

| files                                             | layout     | read as                                               |
|---------------------------------------------------|------------|-------------------------------------------------------|
| a video, alone or in a folder                     | `video`    | with `masks/`, `depth/`, `poses_bounds.npy`, …        |
| `cameras.json`                                    | `cameras`  | the images it names, K, camera_to_world, `valid_mask` |
| `images/`                                         | `endonerf` | `masks/ depth/ images_right/ poses_bounds.npy`        |
| image files                                       | `images`   | a stated default camera                               |
| images or videos named for the left and right eye | `images`, `video` | a stereo pair                                  |
| `session.json`                                    | `session`  | the frames of a live session, with their own times    |

Sidecars have equal meaning in every layout, and each is optional. `recording.json`, which `synthesize` writes, adds
frame rate, camera, unit of depth and stereo baseline.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gsplat_core.errors import InvalidInput
from gsplat_core.io.recordings.calibration import (
    POSES_FILE,
    Calibration,
    Rectification,
    Undistortion,
    default_calibration,
    invert_poses,
    number,
    read_distortion,
    read_json,
    read_pinhole,
    rectified_by_file,
)
from gsplat_core.io.recordings.contents import DESCRIPTION_FILE, Beside, Contents, FrameImages
from gsplat_core.io.recordings.frame_files import ImageFiles, check_sizes, warn_of_rotation
from gsplat_core.io.recordings.packed_eyes import OneEye, stated_layout, warn_of_packed_eyes
from gsplat_core.io.recordings.plain_files import (
    Findings,
    UnreadableFile,
    all_stay_inside,
    check_plain,
    frame_number,
    list_images,
    stays_inside,
)
from gsplat_core.io.recordings.video import VIDEO_SUFFIXES, open_video
from gsplat_core.scene.frames import LONGEST_RECORDING_S

if TYPE_CHECKING:
    from gsplat_core.io.sessions.reader import SessionContents


_UNREAD = frozenset(
    {".tif", ".tiff", ".bmp", ".webp", ".jp2", ".gif", ".dcm", ".ppm", ".pgm", ".exr", ".heic", ".avif"}
)
"""Suffixes of image formats that are not read."""
_LEFT = re.compile(r"(?<![a-z])(left|l)(?![a-z])", re.IGNORECASE)
_RIGHT = re.compile(r"(?<![a-z])(right|r)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class Eyes:
    """Image files grouped by the eye that their names state."""

    left: tuple[Path, ...]
    right: tuple[Path, ...]
    """Right-eye files, in the order of the corresponding left-eye files."""
    others: tuple[Path, ...]
    """Files whose names state neither eye."""


def split_eyes(files: Sequence[Path]) -> Eyes | None:
    """Split files into left and right eye by their names.

    Returns:
        Paired files in order, or None if no pairs exist or a file lacks its counterpart.
    """
    lefts = {_key(_LEFT, path): path for path in files if _LEFT.search(path.stem)}
    rights = {_key(_RIGHT, path): path for path in files if _RIGHT.search(path.stem) and not _LEFT.search(path.stem)}
    if not lefts or lefts.keys() != rights.keys():
        return None
    named = {*lefts.values(), *rights.values()}
    if len(named) != 2 * len(lefts) or len(named) < sum(
        bool(_LEFT.search(p.stem) or _RIGHT.search(p.stem)) for p in files
    ):
        return None
    others = tuple(path for path in files if path not in named)
    return Eyes(tuple(lefts.values()), tuple(rights[key] for key in lefts), others)


def _key(eye: re.Pattern[str], path: Path) -> str:
    return eye.sub("*", path.stem, count=1) + path.suffix


def frame_times(files: Sequence[Path], findings: Findings) -> tuple[float, ...] | None:
    """Return the capture time of each image in frame durations since the first one.

    The most common step between file numbers is one frame duration, so a recording of every tenth
    frame is evenly spaced. Gaps are kept and noted. A repeated or decreasing number is a problem.

    Returns:
        Times [N], or None for evenly spaced images, for names without different numbers, and after a problem.
    """
    numbers = [number for path in files if (number := frame_number(path)) is not None]
    if len(numbers) < len(files) or len(set(numbers)) < 2:
        return None  # The names have no number, or one constant number.
    for earlier, later, first, second in zip(numbers, numbers[1:], files, files[1:], strict=False):
        if later <= earlier:
            findings.problem(
                second,
                f"its number {later} does not follow the number {earlier} of {first.name}",
                "Keep one image for each number, in one sequence",
            )
            return None
    steps = [later - earlier for earlier, later in pairwise(numbers)]
    step = Counter(steps).most_common(1)[0][0]
    gaps = [index for index, wide in enumerate(steps) if wide != step]
    if not gaps:
        return None
    first, second = files[gaps[0]], files[gaps[0] + 1]
    findings.warn(
        files[0].parent,
        f"image numbers skip {len(gaps)} time{'s' * (len(gaps) > 1)}, first from {first.name} to {second.name}",
        "The frames of the missing numbers are left out as a gap in time",
    )
    return tuple((number - numbers[0]) / step for number in numbers)


MAX_NAME = 512
"""Maximum length of a file name including folders."""


def read_cameras_json(root: Path, findings: Findings) -> tuple[ImageFiles, Calibration] | None:
    """Read the images named by `cameras.json`, in its order, and their cameras; None after a problem."""
    path = root / "cameras.json"
    content = read_json(path, findings)
    if content is None:
        return None
    camera, distortion = read_pinhole(path, content, findings), read_distortion(path, content, findings)
    entries = content.get("frames")
    if not isinstance(entries, list) or not entries:
        findings.problem(path, f"frames is {entries!r:.40}", 'Give a list of {"file": …, "camera_to_world": 4x4}')
        return None
    if camera is None or distortion is None:
        return None
    files: list[Path] = []
    poses: list[Any] = []
    for index, entry in enumerate(entries):
        entry = entry if isinstance(entry, dict) else {}
        file = _inside(root, entry.get("file"), path, index, findings)
        pose = _pose(entry.get("camera_to_world"), path, index, findings)
        if file is None or pose is None:
            return None
        files.append(file)
        poses.append(pose)
    size = (camera.width_px, camera.height_px)
    world_to_camera = invert_poses(np.stack(poses)[:, :3], path, findings)
    if world_to_camera is None or check_sizes(files, size, "image", findings) is None:
        return None
    warn_of_rotation(files, findings)
    fps = stated = content.get("fps", content.get("fps_assumed"))
    if stated is not None:
        fps = number(stated)
        if fps is None or not 0.1 <= fps <= 1000:
            findings.problem(path, f"the frame rate is {stated!r:.40}", "Give frames per second from 0.1 to 1000")
            return None
    calibration = Calibration(camera.with_pose(world_to_camera[0]), world_to_camera, path.name, distortion=distortion)
    return ImageFiles(files, *size, fps), calibration


def _pose(value: object, path: Path, index: int, findings: Findings) -> np.ndarray | None:
    try:
        if not isinstance(value, list):
            raise TypeError
        pose = np.array([[np.nan if (each := number(entry)) is None else each for entry in row] for row in value])
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or pose[3].tolist() != [0, 0, 0, 1]:
        findings.problem(
            path,
            f"camera_to_world of frame {index} is {value!r:.60}",
            "Give 4 rows of 4 finite numbers, the last of them 0 0 0 1",
        )
        return None
    return pose


def _inside(root: Path, name: object, path: Path, index: int, findings: Findings) -> Path | None:
    """Resolve a file named by a document, inside the folder.

    Absolute paths, `..` and links out of the folder are problems. The result is then None.
    """
    relative = isinstance(name, str) and 0 < len(name) <= MAX_NAME and "\0" not in name
    if relative:
        posix, windows = PurePosixPath(str(name)), PureWindowsPath(str(name))
        relative = not posix.is_absolute() and not windows.anchor and ".." not in (*posix.parts, *windows.parts)
    if not relative:
        findings.problem(
            path, f"the file of frame {index} is {name!r:.80}", "Give a path inside the recording's folder"
        )
        return None
    file = root / str(name)
    try:
        missing = not os.path.lexists(file)
        check_plain(file)
    except (UnreadableFile, ValueError) as error:
        findings.problem(
            file,
            f"frame {index} cannot be read: {error}",
            "Export it again, or drop it from cameras.json",
            missing=missing,
        )
        return None
    return file if stays_inside(root, file, findings) else None


DEFAULT_FPS = 30.0
SAME_RATE_WITHIN = 0.01
"""Largest relative difference of the frame rates of both eyes' videos; rounded rates and variable intervals differ by less."""
_LAYOUTS = "a video, a folder with video.mp4, with images/ (EndoNeRF), with images and cameras.json, or with images"


def inspect(path: Path, findings: Findings) -> Contents | SessionContents | None:
    """Recognise the layout and run every check that needs no full decoding.

    Args:
        path: video file or folder.
        findings: collector of problems and warnings.

    Returns:
        Contents of the recording, or None if a problem was found.
    """
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except (OSError, RuntimeError, ValueError) as error:
        findings.problem(path, f"it cannot be looked at: {error}", f"Give {_LAYOUTS}")
        return None
    if is_file:
        return _with_sidecars(path, "video", open_video(path, findings), None, findings)
    if not is_folder:
        why = "there is no such file or folder"
        try:
            missing = not os.path.lexists(path)
            check_plain(path)
        except UnreadableFile as error:
            why = why if missing else str(error)
        findings.problem(path, why, f"Check the path; give {_LAYOUTS}", missing=True)
        return None
    try:
        return _inspect_folder(path, findings)
    except OSError as error:
        findings.problem(error.filename or path, f"it cannot be read: {error.strerror}", "Check its permissions")
        return None


def _inspect_folder(path: Path, findings: Findings) -> Contents | SessionContents | None:
    names = sorted(entry.name for entry in path.iterdir())
    if "session.json" in names:
        # Imported lazily: most recordings are not sessions, and the session reader loads slowly.
        from gsplat_core.io.sessions.reader import session_contents

        return session_contents(path, findings)
    videos = [path / name for name in names if Path(name).suffix.lower() in VIDEO_SUFFIXES and name[0] != "."]
    if "cameras.json" in names:
        if not stays_inside(path, path / "cameras.json", findings):
            return None
        images, calibration = read_cameras_json(path, findings) or (None, None)
        return _with_sidecars(path, "cameras", images, calibration, findings)
    if videos:
        return _video_folder(path, videos, findings)
    folder, layout = (path / "images", "endonerf") if "images" in names else (path, "images")
    if not stays_inside(path, folder, findings):
        return None
    files = list_images(folder) if folder.is_dir() else []
    eyes = split_eyes(files) if layout == "images" else None
    if eyes is not None:
        if eyes.others:
            names = [other.name for other in eyes.others]
            findings.warn(path, f"{', '.join(names[:5])} belong to neither eye", "They are not read")
        files = list(eyes.left)
    if not files:
        names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else names
        what = f"found {', '.join(names[:8])}{', …' if len(names) > 8 else ''}" if names else "the folder is empty"
        findings.problem(folder, f"no video and no PNG or JPEG images: {what}", f"Give {_LAYOUTS}", missing=True)
        return None
    _warn_of_unread(folder, findings)
    known = len(findings.problems)
    size = check_sizes(files, None, "image", findings) if all_stay_inside(path, files, findings) else None
    times = frame_times(files, findings)
    if size is None or len(findings.problems) > known:
        return None
    warn_of_rotation(files, findings)
    right = None
    if eyes is not None:
        if check_sizes(eyes.right, size, "right image", findings) is None or not all_stay_inside(
            path, list(eyes.right), findings
        ):
            return None
        right = ImageFiles(eyes.right, *size)
    return _with_sidecars(path, layout, ImageFiles(files, *size, times=times), None, findings, right)


def _warn_of_unread(folder: Path, findings: Findings) -> None:
    """Warn of images beside those that are read, in formats that are not read."""
    names = sorted(entry.name for entry in folder.iterdir() if entry.suffix.lower() in _UNREAD and entry.name[0] != ".")
    if names:
        count = f"{len(names)} image{'s' * (len(names) > 1)}"
        findings.warn(folder, f"{count} of other formats ({', '.join(names[:3])}{', …' if len(names) > 3 else ''})", "They are not read; convert them to PNG to use them")  # fmt: skip


def _video_folder(path: Path, videos: Sequence[Path], findings: Findings) -> Contents | None:
    eyes = split_eyes(videos)
    if eyes is not None and len(eyes.left) == 1 and not eyes.others:
        return _video_pair(path, eyes.left[0], eyes.right[0], findings)
    named = [video for video in videos if video.stem == "video"]
    if len(videos) > 1 and len(named) != 1:
        found = ", ".join(video.name for video in videos[:5])
        findings.problem(path, f"it holds {len(videos)} videos ({found})", "Name the left or only one video.mp4")
        return None
    video = (named or videos)[0]
    if not stays_inside(path, video, findings):
        return None
    return _with_sidecars(path, "video", open_video(video, findings), None, findings)


def _video_pair(path: Path, left: Path, right: Path, findings: Findings) -> Contents | None:
    """Open a pair of videos, one per eye; None after a problem."""
    if not (stays_inside(path, left, findings) and stays_inside(path, right, findings)):
        return None
    images = open_video(left, findings)
    other = open_video(right, findings) if images is not None else None
    if images is None or other is None:
        return None
    ours, theirs = ((each.frame_count, each.width_px, each.height_px) for each in (images, other))
    if ours != theirs:
        findings.problem(
            right,
            f"it has {theirs[0]} frames of {theirs[1]}x{theirs[2]} px, {left.name} has {ours[0]} of {ours[1]}x{ours[2]}",
            "Give as many frames of one size for both eyes, taken at the same moments",
        )
        return None
    if images.fps and other.fps and abs(other.fps / images.fps - 1) > SAME_RATE_WITHIN:
        findings.problem(
            right,
            f"it has {other.fps:g} frames/s, {left.name} has {images.fps:g}, so their frames are of different moments",
            "Give videos of one frame rate for both eyes, taken at the same moments",
        )
        return None
    return _with_sidecars(path, "video", images, None, findings, other)


def _with_sidecars(
    root: Path,
    layout: str,
    images: FrameImages | None,
    calibration: Calibration | None,
    findings: Findings,
    right_eye: FrameImages | None = None,
) -> Contents | None:
    """Add the sidecar files to the images. Missing sidecars are skipped; a present but unusable one is a problem.

    Returns:
        The contents; None without images or after a problem.
    """
    if images is None:
        return None
    known = len(findings.problems)
    eyes_layout = stated_layout(root, images, findings)
    if len(findings.problems) > known:
        return None
    if eyes_layout is not None:
        if right_eye is not None or calibration is not None or (root / "images_right").exists():
            findings.problem(
                root / DESCRIPTION_FILE,
                f"it states stereo {eyes_layout!r}, and cameras.json or pictures of a right eye are there too",
                "Remove one of them; recording.json can also state the camera of one eye",
            )
            return None
        images, right_eye = OneEye(images, eyes_layout, right=False), OneEye(images, eyes_layout, right=True)
    size = (images.width_px, images.height_px)
    # A video given as a file has no sidecars.
    beside = Beside(root if root.is_dir() else None, images, findings)
    described = beside.description()
    if calibration is None:
        calibration = beside.poses()
    right: FrameImages | None = right_eye or beside.right()
    if right is None:
        warn_of_packed_eyes(root, images, findings, may_state=layout != "cameras")
    masks, depth = beside.masks(), beside.depth(described.get("depth_unit_mm"))
    tool_share = masks.check_polarity(findings) if masks else None
    valid_mask, labels, scans = beside.valid_mask(), beside.labels(), beside.scans()
    if len(findings.problems) > known:
        return None
    if depth is not None:
        depth.check_unit(findings)
    eyes = _calibrated(root, size, calibration, beside, findings, stereo=right is not None)
    if len(findings.problems) > known:
        return None
    if not _fits_eyes(root, eyes, right is not None, depth is not None, findings):
        return None
    if scans is not None and (eyes.rectification is not None or eyes.undistortion is not None):
        findings.problem(
            root / "scans",
            "the scans belong to pictures that are not rectified",
            "Rectify the pictures, or remove scans/",
        )
        return None
    fps = described.get("fps") or images.fps
    if fps is None:
        findings.warn(root, "the frame rate is not stated", f"{DEFAULT_FPS:g} frames/s are assumed")
        fps = DEFAULT_FPS
    if images.keeps_times and images.fps is not None and fps != images.fps:
        findings.warn(
            root,
            f"{DESCRIPTION_FILE} states {fps:g} frames/s, and the video has {images.fps:.4g} frames/s on average",
            "Its frames keep their times in the file",
        )
        fps = images.fps
    last = images.times[-1] if images.times else images.frame_count - 1
    if last > LONGEST_RECORDING_S * fps:
        findings.problem(
            root,
            f"its last frame is {last / fps:.6g} s after the first one, at {fps:g} frames/s",
            f"Recordings last up to {LONGEST_RECORDING_S:g} s; check the frame rate, and the numbers or times of the frames",
        )
        return None
    if images.frame_count == 1:
        findings.warn(
            root, "it has one frame: nothing can be held out and nothing moves", "Give more frames to measure"
        )
    return Contents(
        root=root,
        layout=layout,
        images=images,
        calibration=eyes.calibration,
        fps=fps,
        right=right,
        masks=masks,
        valid_mask=valid_mask,
        depth=depth,
        labels=labels,
        scans=scans,
        tool_share=tool_share,
        stereo_baseline_mm=eyes.baseline_mm,
        rectification=eyes.rectification,
        undistortion=eyes.undistortion,
        other_files=(*beside.files(), *eyes.files),
    )


class _Calibrated(NamedTuple):
    """Camera calibration assembled from all files that state one, with the maps for pictures that must be corrected."""

    calibration: Calibration
    baseline_mm: float | None
    rectification: Rectification | None = None
    files: tuple[Path, ...] = ()
    undistortion: Undistortion | None = None


def _calibrated(
    root: Path, size: tuple[int, int], found: Calibration | None, beside: Beside, findings: Findings, *, stereo: bool
) -> _Calibrated:
    """Combine all calibration sources of a recording.

    Args:
        root: folder or video of the recording.
        size: width and height in pixels.
        found: calibration of the left camera from the image layout, if any.
        beside: sidecar files.
        findings: collector of problems and warnings.
        stereo: True if the recording has a right eye.
    """
    described, poses = beside.description(), beside.poses_alone()
    rectified = rectified_by_file(root, size, found, findings) if stereo and root.is_dir() else None
    stated = described.get("camera")
    if rectified is not None:
        found = rectified.calibration
    elif found is None and stated is not None:
        found = Calibration(stated, None, DESCRIPTION_FILE, distortion=described.get("distortion", ()))
    elif found is None:
        found = default_calibration(root, *size, findings, poses_known=poses is not None)
    elif stated is not None:
        camera = stated.with_pose(found.camera.world_to_camera)
        found = replace(found, camera=camera, distortion=described.get("distortion", ()))
    if poses is not None:
        poses = poses if rectified is None else rectified.by.turn @ poses
        camera = found.camera.with_pose(poses[0])
        source = f"{POSES_FILE}, and the camera of {found.source}"
        found = replace(found, camera=camera, poses=poses, source=source)
    if rectified is None:
        baseline_mm = described.get("stereo_baseline_mm")
        if not found.distortion:
            return _Calibrated(found, baseline_mm)
        return _undistorted(root, found, baseline_mm, stereo, findings)
    return _Calibrated(found, rectified.baseline_mm, rectified.by, rectified.files)


def _undistorted(
    root: Path, found: Calibration, baseline_mm: float | None, stereo: bool, findings: Findings
) -> _Calibrated:
    """Return the calibration of the undistorted pictures with the undistortion maps; after a problem `found` without maps."""
    if stereo:
        findings.problem(
            root,
            f"{found.source} states the distortion of one eye, and there are two",
            "Give a stereo calibration file, or undistort and rectify the pictures and leave out distortion",
        )
        return _Calibrated(found, baseline_mm)
    try:
        undistortion = Undistortion(found.camera, found.distortion)
    except InvalidInput as error:
        findings.problem(root, f"{found.source}: {error}", "Calibrate again, with fewer coefficients")
        return _Calibrated(found, baseline_mm)
    return _Calibrated(replace(found, camera=undistortion.camera), baseline_mm, undistortion=undistortion)


PLAUSIBLE_BASELINE_MM = (0.5, 100.0)
"""Range of the distance between the two eyes of a stereo endoscope, in mm. A calibration in metres or centimetres is
below it, one in micrometres above it."""


def _fits_eyes(root: Path, eyes: _Calibrated, stereo: bool, has_depth: bool, findings: Findings) -> bool:
    """Check that depth and stereo data fit the calibration. An implausible baseline only causes a warning.

    Returns:
        False if depth maps belong to unrectified pictures, which is a problem. A stereo pair
            without a baseline only causes a warning.
    """
    if eyes.rectification is not None and has_depth:
        findings.problem(
            root, "it has depth for pictures that are not rectified", "Rectify pictures and depth, or remove depth/"
        )
        return False
    if stereo and eyes.baseline_mm is None and not has_depth:
        findings.warn(
            root,
            "the two eyes have no calibration",
            "Depth between them is relative until a calibration file, or stereo_baseline_mm of a rectified pair, is there",
        )
    low, high = PLAUSIBLE_BASELINE_MM
    if stereo and eyes.baseline_mm is not None and not low <= eyes.baseline_mm <= high:
        findings.warn(
            root,
            f"the two eyes are {eyes.baseline_mm:.3g} mm apart",
            f"Those of stereo endoscopes are {low:g} to {high:g} mm apart. Check that the calibration is in millimetres",
        )
    return True
