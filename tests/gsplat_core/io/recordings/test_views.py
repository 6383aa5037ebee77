"""`views.json` from unknown hands."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsplat_core.errors import RecordingError
from gsplat_core.io.recordings.truth import open_truth, open_views
from tests.gsplat_core.io.recordings.conftest import HEIGHT, WIDTH, write_images

CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 50.0, "fy": 50.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}


def described(**changes: Any) -> dict[str, Any]:
    view = {"name": "side", "folder": "views/side", "camera": CAMERA, "left_to_view": np.eye(4).tolist(), **changes}
    return {"format": "intrasplat-views", "version": 1, "views": [view]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_images(tmp_path / "views" / "side" / "images", 3)
    return tmp_path


def test_view_requires_only_pictures(folder: Path) -> None:
    (folder / "views.json").write_text(json.dumps(described()))
    (view,) = open_views(folder, 3)
    frame = view.read(2)
    assert frame.image.shape == (HEIGHT, WIDTH, 3) and frame.image[0, 0, 0] == 50
    assert frame.depth is None and frame.mask is None
    assert len(open_views(folder, 2)) == 1  # of a recording that is read in part
    assert open_truth(folder / "nowhere", 3).views == ()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"folder": "../elsewhere"}, "outside"),
        ({"folder": "/etc"}, "outside"),
        ({"folder": "views/missing"}, "no pictures"),
        ({"folder": 3}, "Give a word each"),
        ({"name": "../x"}, "Give a word each"),
        ({"camera": None}, "Give name, folder, camera"),
        ({"camera": {**CAMERA, "fx": -1.0}}, "fx"),
        ({"camera": {**CAMERA, "width": 64}}, "64"),
        ({"left_to_view": None}, "is no pose"),
        ({"left_to_view": [[1, 2], [3]]}, "is no pose"),
        ({"left_to_view": (2 * np.eye(4)).tolist()}, "is no pose"),
        ({"left_to_view": np.diag([1.0, 1, -1, 1]).tolist()}, "is no pose"),
        ({"left_to_view": [["a"] * 4] * 4}, "is no pose"),
    ],
)
def test_open_views_refuses_invalid_view(folder: Path, changes: dict[str, Any], said: str) -> None:
    (folder / "views.json").write_text(json.dumps(described(**changes)))
    with pytest.raises(RecordingError, match=said):
        open_views(folder, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([], "views.json"),
        ({"format": "other", "version": 1, "views": []}, "does not describe views"),
        ({**described(), "views": described()["views"] * 17}, "at most 16"),
        ({**described(), "depth_unit_mm": 0}, "depth_unit_mm is 0"),
        ({**described(), "depth_unit_mm": "wide"}, "depth_unit_mm is 'wide'"),
    ],
)
def test_open_views_refuses_invalid_description(folder: Path, content: Any, said: str) -> None:
    (folder / "views.json").write_text(json.dumps(content))
    with pytest.raises(RecordingError, match=said):
        open_views(folder, 3)


def test_open_views_refuses_link_out_of_folder(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    write_images(elsewhere / "images", 3)
    (folder / "views" / "far").symlink_to(elsewhere)
    (folder / "views.json").write_text(json.dumps(described(folder="views/far")))
    with pytest.raises(RecordingError, match="far"):
        open_views(folder, 3)


@pytest.mark.parametrize("name", ["tracks.npy", "tracks_seen.npy"])
def test_open_truth_refuses_tracks_of_wrong_shape(folder: Path, name: str) -> None:
    fits: dict[str, Callable[[], np.ndarray]] = {
        "tracks.npy": lambda: np.zeros((3, 5, 3), np.float32),
        "tracks_seen.npy": lambda: np.ones((3, 5), np.uint8),
    }
    for each, make in fits.items():
        np.save(folder / each, make())
    assert open_truth(folder, 3).tracks is not None
    for wrong in (np.zeros((2, 5, 3)), np.zeros(3), np.zeros((3, 6))):
        np.save(folder / name, wrong)
        with pytest.raises(RecordingError, match="tracks"):
            open_truth(folder, 3)
    (folder / name).unlink()
    assert open_truth(folder, 3).tracks is None
