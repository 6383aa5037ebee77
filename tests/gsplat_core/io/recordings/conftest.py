"""Small recordings of each layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingError
from gsplat_core.io.recordings import open_recording, synthesize, validate_recording

WIDTH, HEIGHT = 48, 40


def frame_image(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return an RGB image that identifies its frame: red grows with the index, green with the column, blue with the row."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = 20 * index + 10
    image[..., 1] = np.linspace(0, 255, width).astype(np.uint8)
    image[..., 2] = np.linspace(0, 255, height).astype(np.uint8)[:, None]
    return image


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_images(
    folder: Path, count: int, pattern: str = "{:06d}.png", size: tuple[int, int] = (WIDTH, HEIGHT)
) -> None:
    for index in range(count):
        write_image(folder / pattern.format(index), frame_image(index, *size))


def write_masks(folder: Path, count: int, size: tuple[int, int] = (WIDTH, HEIGHT), tool_columns: int = 12) -> None:
    """Write masks with the tool (255) in the leftmost columns."""
    mask = np.zeros((size[1], size[0]), np.uint8)
    mask[:, :tool_columns] = 255
    for index in range(count):
        write_image(folder / f"{index:06d}.png", mask)


def write_poses_bounds(
    path: Path, count: int, size: tuple[int, int] = (WIDTH, HEIGHT), focal: float = 50.0
) -> np.ndarray:
    table = np.zeros((count, 17))
    poses = table[:, :15].reshape(count, 3, 5)
    poses[:, :3, :3] = np.eye(3)
    poses[:, :, 4] = size[1], size[0], focal
    table[:, :15] = poses.reshape(count, 15)
    table[:, 15:] = 10, 100
    np.save(path, table)
    return table


def write_video(
    path: Path, count: int, size: tuple[int, int] = (WIDTH, HEIGHT), codec: str = "mp4v", fps: float = 25
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, size)
    assert writer.isOpened()
    for index in range(count):
        writer.write(np.ascontiguousarray(frame_image(index, *size)[..., ::-1]))
    writer.release()


@pytest.fixture
def make() -> SimpleNamespace:
    """Builders of recordings, for tests that need their own."""
    return SimpleNamespace(
        width=WIDTH,
        height=HEIGHT,
        frame_image=frame_image,
        image=write_image,
        images=write_images,
        masks=write_masks,
        poses_bounds=write_poses_bounds,
        video=write_video,
    )


@pytest.fixture
def video_folder(tmp_path: Path) -> Path:
    """Eight frames of video with masks and poses."""
    write_video(tmp_path / "rec" / "video.mp4", 8)
    write_masks(tmp_path / "rec" / "masks", 8)
    write_poses_bounds(tmp_path / "rec" / "poses_bounds.npy", 8)
    return tmp_path / "rec"


@pytest.fixture
def endonerf_folder(tmp_path: Path) -> Path:
    """Six frames in the EndoNeRF layout with all optional files."""
    root = tmp_path / "endo"
    write_images(root / "images", 6, "frame-{:06d}.color.png")
    write_images(root / "images_right", 6, "frame-{:06d}.color.png")
    write_masks(root / "masks", 6)
    for index in range(6):
        depth = np.full((HEIGHT, WIDTH), 40 + index, np.uint8)
        depth[0, 0] = 0
        write_image(root / "depth" / f"frame-{index:06d}.depth.png", depth)
    write_poses_bounds(root / "poses_bounds.npy", 6)
    return root


@pytest.fixture
def cameras_folder(tmp_path: Path) -> Path:
    """Five images with `cameras.json`: the camera moves 2 along x for each frame."""
    root = tmp_path / "moving"
    write_images(root / "images", 5)
    frames = []
    for index in range(5):
        pose = np.eye(4)
        pose[0, 3] = 2 * index
        frames.append({"file": f"images/{index:06d}.png", "camera_to_world": pose.tolist()})
    camera = {"width": WIDTH, "height": HEIGHT, "fx": 50.0, "fy": 51.0, "cx": 23.0, "cy": 21.0, "fps_assumed": 20}
    (root / "cameras.json").write_text(json.dumps({**camera, "frames": frames}))
    valid = np.zeros((HEIGHT, WIDTH), np.uint8)
    valid[5:-5, 5:-5] = 255
    write_image(root / "valid_mask.png", valid)
    return root


@pytest.fixture(scope="session")
def synthetic_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames at 0, 1/3, 2/3 and 1 s, rendered with a moving camera."""
    return synthesize(
        tmp_path_factory.mktemp("synthetic") / "rec",
        frames=4,
        width_px=96,
        height_px=80,
        fps=3,
        seed=5,
        camera="moving",
    )


@pytest.fixture
def refused() -> Callable[..., str]:
    """Check that a recording is refused, with the same message by opening (or reading) and by `validate`."""

    def check(path: Path, error: type[RecordingError], *fragments: str) -> str:
        with pytest.raises(error) as caught:
            for _ in open_recording(path):
                pass
        message = str(caught.value)
        for fragment in fragments:
            assert fragment in message
        report = validate_recording(path)
        assert not report.ok
        assert message in [str(problem) for problem in report.problems]
        assert all(problem.file and problem.message and problem.advice for problem in report.problems)
        return message

    return check
