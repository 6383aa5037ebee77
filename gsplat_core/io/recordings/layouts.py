"""Recognising a recording by what lies in its folder.

| what is there                                     | layout     | read as                                               |
|---------------------------------------------------|------------|-------------------------------------------------------|
| a video, alone or in a folder                     | `video`    | beside it `masks/`, `depth/`, `poses_bounds.npy`, …   |
| `cameras.json`                                    | `cameras`  | the images it names, K, camera_to_world, `valid_mask` |
| `images/`                                         | `endonerf` | `masks/ depth/ images_right/ poses_bounds.npy`        |
| image files                                       | `images`   | a stated default camera                               |
| images or videos named for the left and right eye | `images`, `video` | a stereo pair                                  |
| `session.json`                                    | `session`  | what came in during a live session, with its own times |

The sidecars mean the same in every layout and each is optional. `recording.json`, which `synthesize` writes, adds what
the layouts cannot say: frame rate, camera, unit of depth, stereo baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from gsplat_core.geometry.rectification import Rectification
from gsplat_core.io.recordings.calibration import Calibration, default_calibration
from gsplat_core.io.recordings.cameras_json import read_cameras_json
from gsplat_core.io.recordings.contents import Contents, FrameImages
from gsplat_core.io.recordings.eyes import split_eyes
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import ImageFiles, check_sizes
from gsplat_core.io.recordings.image_files import list_images
from gsplat_core.io.recordings.numbering import frame_times
from gsplat_core.io.recordings.plain_files import all_stay_inside, stays_inside
from gsplat_core.io.recordings.poses_file import POSES_FILE
from gsplat_core.io.recordings.sidecars import DESCRIPTION_FILE, Beside
from gsplat_core.io.recordings.stereo_calibration import rectified_by_file
from gsplat_core.io.recordings.video import VIDEO_SUFFIXES, open_video

if TYPE_CHECKING:
    from gsplat_core.io.sessions.contents import SessionContents

DEFAULT_FPS = 30.0
_LAYOUTS = "a video, a folder with video.mp4, with images/ (EndoNeRF), with images and cameras.json, or with images"


def inspect(path: Path, findings: Findings) -> Contents | SessionContents | None:
    """Recognise the layout and make every check that needs no decoding of all frames; None where there is a problem."""
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except (OSError, RuntimeError, ValueError) as error:
        findings.problem(path, f"it cannot be looked at: {error}", f"Give {_LAYOUTS}")
        return None
    if is_file:
        return _with_sidecars(path, "video", open_video(path, findings), None, findings)
    if not is_folder:
        findings.problem(path, "there is no such file or folder", f"Check the path; give {_LAYOUTS}", missing=True)
        return None
    try:
        return _inspect_folder(path, findings)
    except OSError as error:
        findings.problem(error.filename or path, f"it cannot be read: {error.strerror}", "Check its permissions")
        return None


def _inspect_folder(path: Path, findings: Findings) -> Contents | SessionContents | None:
    names = sorted(entry.name for entry in path.iterdir())
    if "session.json" in names:
        # Only now: most recordings are none, and what checks a session's log takes a while to load.
        from gsplat_core.io.sessions.contents import session_contents

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
        what = f"found {', '.join(names[:8])}{', …' if len(names) > 8 else ''}" if names else "the folder is empty"
        findings.problem(folder, f"no video and no PNG or JPEG images: {what}", f"Give {_LAYOUTS}", missing=True)
        return None
    known = len(findings.problems)
    size = check_sizes(files, None, "image", findings) if all_stay_inside(path, files, findings) else None
    times = frame_times(files, findings)
    if size is None or len(findings.problems) > known:
        return None
    right = None
    if eyes is not None:
        if check_sizes(eyes.right, size, "right image", findings) is None or not all_stay_inside(
            path, list(eyes.right), findings
        ):
            return None
        right = ImageFiles(eyes.right, *size)
    return _with_sidecars(path, layout, ImageFiles(files, *size, times=times), None, findings, right)


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
    """A video for each eye."""
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
    return _with_sidecars(path, "video", images, None, findings, other)


def _with_sidecars(
    root: Path,
    layout: str,
    images: FrameImages | None,
    calibration: Calibration | None,
    findings: Findings,
    right_eye: FrameImages | None = None,
) -> Contents | None:
    """Add what lies beside the images. What is not there is left out; what is there and cannot be used is a problem."""
    if images is None:
        return None
    known = len(findings.problems)
    size = (images.width_px, images.height_px)
    # A video that is given itself has nothing beside it.
    beside = Beside(root if root.is_dir() else None, images, findings)
    described = beside.description()
    if calibration is None:
        calibration = beside.poses()
    right: FrameImages | None = right_eye or beside.right()
    masks, depth = beside.masks(), beside.depth(described.get("depth_unit_mm"))
    tool_share = masks.check_polarity(findings) if masks else None
    valid_mask = beside.valid_mask()
    if len(findings.problems) > known:
        return None
    eyes = _calibrated(root, size, calibration, beside, findings, stereo=right is not None)
    if len(findings.problems) > known:
        return None
    if not _fits_eyes(root, eyes, right is not None, depth is not None, findings):
        return None
    if valid_mask is not None and eyes.rectification is not None:
        valid_mask = eyes.rectification.plane(valid_mask)
    fps = described.get("fps") or images.fps
    if fps is None:
        findings.warn(root, "the frame rate is not stated", f"{DEFAULT_FPS:g} frames/s are assumed")
        fps = DEFAULT_FPS
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
        tool_share=tool_share,
        stereo_baseline_mm=eyes.baseline_mm,
        rectification=eyes.rectification,
        other_files=(*beside.files(), *eyes.files),
    )


class _Calibrated(NamedTuple):
    """What is known of the cameras."""

    calibration: Calibration
    baseline_mm: float | None
    rectification: Rectification | None = None
    files: tuple[Path, ...] = ()


def _calibrated(
    root: Path, size: tuple[int, int], found: Calibration | None, beside: Beside, findings: Findings, *, stereo: bool
) -> _Calibrated:
    """The cameras, from all that lies beside the images. found: what one file says of the left one. stereo: whether there is another eye."""
    described, poses = beside.description(), beside.poses_alone()
    rectified = rectified_by_file(root, size, found, findings) if stereo and root.is_dir() else None
    stated = described.get("camera")
    if rectified is not None:
        found = rectified.calibration
    elif found is None and stated is not None:
        found = Calibration(stated, None, DESCRIPTION_FILE)
    elif found is None:
        found = default_calibration(root, *size, findings, poses_known=poses is not None)
    elif stated is not None:
        found = replace(found, camera=stated.with_pose(found.camera.world_to_camera))
    if poses is not None:
        poses = poses if rectified is None else rectified.by.turn @ poses
        camera = found.camera.with_pose(poses[0])
        source = f"{POSES_FILE}, and the camera of {found.source}"
        found = Calibration(camera, poses, source, found.assumed)
    if rectified is None:
        return _Calibrated(found, described.get("stereo_baseline_mm"))
    return _Calibrated(found, rectified.baseline_mm, rectified.by, rectified.files)


def _fits_eyes(root: Path, eyes: _Calibrated, stereo: bool, has_depth: bool, findings: Findings) -> bool:
    """Whether depth can be that of the left eye; a warning where it cannot be found in millimetres."""
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
    return True
