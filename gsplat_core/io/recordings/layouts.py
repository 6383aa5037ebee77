"""Recognising a recording by what lies in its folder.

| what is there                                     | layout     | read as                                               |
|---------------------------------------------------|------------|-------------------------------------------------------|
| a video, alone or in a folder                     | `video`    | beside it `masks/`, `depth/`, `poses_bounds.npy`, …   |
| `cameras.json`                                    | `cameras`  | the images it names, K, camera_to_world, `valid_mask` |
| `images/`                                         | `endonerf` | `masks/ depth/ images_right/ poses_bounds.npy`        |
| image files                                       | `images`   | a stated default camera                               |
| `session.json`                                    | `session`  | what came in during a live session, with its own times |

The sidecars mean the same in every layout and each is optional. `recording.json`, which `synthesize` writes, adds what
the layouts cannot say: frame rate, camera, unit of depth, stereo baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsplat_core.io.recordings.calibration import Calibration, default_calibration
from gsplat_core.io.recordings.cameras_json import read_cameras_json
from gsplat_core.io.recordings.contents import Contents, FrameImages
from gsplat_core.io.recordings.findings import Findings
from gsplat_core.io.recordings.frame_files import ImageFiles, check_sizes
from gsplat_core.io.recordings.image_files import list_images
from gsplat_core.io.recordings.numbering import frame_times
from gsplat_core.io.recordings.plain_files import all_stay_inside, stays_inside
from gsplat_core.io.recordings.poses_file import POSES_FILE
from gsplat_core.io.recordings.sidecars import Beside
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
    if not files:
        what = f"found {', '.join(names[:8])}{', …' if len(names) > 8 else ''}" if names else "the folder is empty"
        findings.problem(folder, f"no video and no PNG or JPEG images: {what}", f"Give {_LAYOUTS}", missing=True)
        return None
    known = len(findings.problems)
    size = check_sizes(files, None, "image", findings) if all_stay_inside(path, files, findings) else None
    times = frame_times(files, findings)
    if size is None or len(findings.problems) > known:
        return None
    return _with_sidecars(path, layout, ImageFiles(files, *size, times=times), None, findings)


def _video_folder(path: Path, videos: Sequence[Path], findings: Findings) -> Contents | None:
    named = [video for video in videos if video.stem == "video"]
    if len(videos) > 1 and len(named) != 1:
        found = ", ".join(video.name for video in videos[:5])
        findings.problem(path, f"it holds {len(videos)} videos ({found})", "Name the left or only one video.mp4")
        return None
    video = (named or videos)[0]
    if not stays_inside(path, video, findings):
        return None
    return _with_sidecars(path, "video", open_video(video, findings), None, findings)


def _with_sidecars(
    root: Path, layout: str, images: FrameImages | None, calibration: Calibration | None, findings: Findings
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
    poses = beside.poses_alone()
    right, masks, depth = beside.right(), beside.masks(), beside.depth(described.get("depth_unit_mm"))
    tool_share = masks.check_polarity(findings) if masks else None
    valid_mask = beside.valid_mask()
    if len(findings.problems) > known:
        return None
    if calibration is None:
        calibration = default_calibration(root, *size, findings)
    if camera := described.get("camera"):
        calibration = replace(calibration, camera=camera.with_pose(calibration.camera.world_to_camera))
    if poses is not None:
        camera = calibration.camera.with_pose(poses[0])
        calibration = Calibration(camera, poses, f"{POSES_FILE}, and the camera of {calibration.source}")
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
        calibration=calibration,
        fps=fps,
        right=right,
        masks=masks,
        valid_mask=valid_mask,
        depth=depth,
        tool_share=tool_share,
        stereo_baseline_mm=described.get("stereo_baseline_mm"),
        other_files=beside.files(),
    )
