"""Class labels and scans of a range sensor, which some frames of a recording have."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording
from gsplat_core.scene.range_sensors import OctLine, StructuredLight

SENSOR = {"sensor": "structured_light", "nearest": 40, "farthest": 90, "bins": 8}


@pytest.fixture
def folder(endonerf_folder):
    """A recording with labels on frame 1 and a scan on frame 2."""
    recording = open_recording(endonerf_folder)
    height, width = recording.height_px, recording.width_px
    names = sorted(path.stem for path in (endonerf_folder / "images").iterdir())
    labels = np.full((height, width), 255, np.uint8)
    labels[:, : width // 2] = 2
    (endonerf_folder / "labels").mkdir()
    cv2.imwrite(str(endonerf_folder / "labels" / f"{names[1]}.png"), labels)
    (endonerf_folder / "scans").mkdir()
    (endonerf_folder / "scans" / "sensor.json").write_text(json.dumps(SENSOR))
    counts = np.arange(width * 8, dtype=np.float32).reshape(width, 8)
    np.save(endonerf_folder / "scans" / f"{names[2]}.npy", counts)
    return endonerf_folder


def test_labels_and_scans_belong_to_numbered_frames(folder):
    recording = open_recording(folder)
    assert {"labels", "ranges"} <= recording.fields
    frames = list(recording)
    assert [frame.seq for frame in frames if frame.labels is not None] == [1]
    assert [frame.seq for frame in frames if frame.ranges is not None] == [2]
    assert np.unique(frames[1].labels).tolist() == [2, 255]
    scan = frames[2].ranges
    assert scan.sensor == StructuredLight(40.0, 90.0, 8) and scan.counts.shape == (recording.width_px, 8)


def test_recording_digest_includes_labels_and_scans(folder):
    before = open_recording(folder).digest
    (folder / "scans" / "sensor.json").write_text(json.dumps({**SENSOR, "farthest": 91}))
    assert open_recording(folder).digest != before


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_scaled_recording_scales_labels_and_scans(folder, scale):
    whole, scaled = (list(open_recording(folder, scale=each)) for each in (1.0, scale))
    assert scaled[1].labels.shape == scaled[1].image.shape[:2] and set(np.unique(scaled[1].labels)) == {2, 255}
    counts, wanted = scaled[2].ranges.counts, whole[2].ranges.counts
    assert counts.shape == (scaled[2].width_px, 8)
    assert np.allclose(counts.mean(0), wanted.mean(0), rtol=1e-5)
    if scale == 0.5:
        assert np.allclose(counts[0], wanted[:2].mean(0))


def test_scaled_oct_line_keeps_relative_row_and_thickness(folder):
    content = {"sensor": "oct_line", "nearest": 0, "farthest": 90, "bins": 8, "row": 0.25, "thickness_px": 4}
    (folder / "scans" / "sensor.json").write_text(json.dumps(content))
    sensor = list(open_recording(folder, scale=0.5))[2].ranges.sensor
    assert sensor == OctLine(0.0, 90.0, 8, row=0.25, thickness_px=2)


def bad_label(folder, value):
    path = next((folder / "labels").iterdir())
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    labels[0, 0] = value
    cv2.imwrite(str(path), labels)


def sensor(folder, **changes):
    content = {**SENSOR, **changes}
    (folder / "scans" / "sensor.json").write_text(json.dumps({k: v for k, v in content.items() if v is not None}))


def scan(folder, counts):
    np.save(next((folder / "scans").glob("*.npy")), counts)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: bad_label(f, 7), "the class 7; .*0 to 3|the class 7"),
        (lambda f: next((f / "labels").iterdir()).rename(f / "labels" / "999.png"), "no frame of this number"),
        (lambda f: [path.unlink() for path in (f / "labels").iterdir()], "no label picture"),
        (lambda f: (f / "scans" / "sensor.json").unlink(), r"sensor\.json"),
        (lambda f: sensor(f, sensor="radar"), "'radar'"),
        (lambda f: sensor(f, farthest=None), "does not state farthest"),
        (lambda f: sensor(f, farthest=10), "nearest < farthest"),
        (lambda f: sensor(f, bins=7.5), "bins is 7.5"),
        (lambda f: sensor(f, colour="red"), "no 'colour'"),
        (lambda f: scan(f, np.zeros((3, 8))), r"\[3, 8\] in place of"),
        (lambda f: scan(f, np.full((48, 8), -1.0)), "in place of|negative"),
    ],
)
def test_invalid_label_or_scan_files_are_refused(folder, change, reason):
    change(folder)
    with pytest.raises(RecordingInvalid, match=reason):
        list(open_recording(folder))
