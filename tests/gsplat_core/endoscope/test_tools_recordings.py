"""Tools in the real recordings, with the same settings for each."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsplat_core.endoscope.tools import ToolFinder
from gsplat_core.io.recordings import open_recording

pytestmark = pytest.mark.recordings


def tool_ious(folder: Path, change) -> list[float]:
    finder, found = ToolFinder(), []
    for frame in open_recording(folder):
        if frame.seq % 4:
            continue
        tool = frame.mask == 0
        mask = finder.find(change(frame.image)) == 0
        found.append((mask & tool).sum() / (mask | tool).sum())
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "gains", [(1, 1, 1), (0.4, 0.4, 0.4), (1.15, 1, 0.85), (0.8, 1, 1.1)], ids=["as it is", "dark", "warm", "cold"]
)
def test_tool_finder_finds_tool_in_cutting(recordings_dir, gains):
    found = tool_ious(
        recordings_dir / "cutting", lambda image: np.clip(image * np.array(gains), 0, 255).astype(np.uint8)
    )
    assert len(found) == 39 and np.mean(found) >= 0.75 and min(found) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most"), [("sinus", 0.0), ("colon", 0.0)])
def test_tool_finder_finds_nothing_in_recordings_without_tool(recordings_dir, name, most):
    finder = ToolFinder()
    assert max(float((finder.find(frame.image) == 0).mean()) for frame in open_recording(recordings_dir / name)) <= most


@pytest.mark.parametrize(
    ("picture", "most"),
    [
        ("hamlyn_pair/f7_dynamic_deint_L_0100.png", 0.0),
        ("scared_pair/left.png", 0.01),
        ("scared_raw/Left_Image.png", 0.01),
    ],
)
def test_tool_finder_few_false_tools_in_single_images(recordings_dir, picture, most):
    image = np.ascontiguousarray(cv2.imread(str(recordings_dir / picture))[..., ::-1])
    assert (ToolFinder().find(image) == 0).mean() <= most
