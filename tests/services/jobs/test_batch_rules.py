"""`batch`: changed recordings and results, folders that are no batch, names and options."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from gsplat_core.depth.maps import DEPTHS
from gsplat_core.errors import InvalidSetting
from operators.output_folder import OutputFolder
from operators.settings import CallerJobOptions, JobOptions
from services.errors import StoreUnavailable
from services.jobs.batch import Batch, recordings_in
from services.jobs.store import JOBS, JobState, JobStore


@pytest.fixture
def place(tmp_path):
    """A batch of two recordings with their results."""
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / name).write_bytes(name.encode() * 10_000)
    begin(tmp_path)
    for name in ("a.mp4", "b.mp4"):
        with OutputFolder(tmp_path / "made" / name, "replay") as output:
            for file in ("report.json", "frames.jsonl"):
                (output.path / file).write_text("{}")
            output.publish()
        (tmp_path / "made" / name).rename(tmp_path / "out" / name)
    return tmp_path


def begin(place: Path, done: bool = True) -> dict[str, int]:
    """Begin the batch as the command does, and mark every job as done."""
    batch = Batch(place / "in", place / "out", JobOptions())
    counts = batch._store.counts()
    with batch._store.database.writing() as connection:
        connection.execute(JOBS.update().values(state=str(JobState.DONE)))
    batch._store.close()
    return counts


def test_batch_skips_recordings_with_results(place):
    assert begin(place)["done"] == 2


def test_batch_queues_recording_whose_result_was_removed(place):
    shutil.rmtree(place / "out" / "a.mp4")
    counts = begin(place)
    assert (counts["done"], counts["queued"]) == (1, 1)


@pytest.mark.parametrize("file", ["report.json", "frames.jsonl", ".intrasplat.json"])
def test_batch_refuses_result_with_missing_files(place, file):
    (place / "out" / "a.mp4" / file).unlink()
    with pytest.raises(InvalidSetting, match=r"out/a\.mp4 are missing"):
        begin(place)


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path.write_bytes(b"a longer one" * 10_000),
        lambda path: path.write_bytes(path.read_bytes()[:-1] + b"x"),
        lambda path: (path.unlink(), path.mkdir(), (path / "0.png").touch()),
        lambda path: shutil.copy(path.with_name("b.mp4"), path),
    ],
)
def test_batch_refuses_changed_recording_until_its_result_is_removed(place, change):
    change(place / "in" / "a.mp4")
    with pytest.raises(InvalidSetting, match=r"a\.mp4 is another recording"):
        begin(place)
    shutil.rmtree(place / "out" / "a.mp4")
    assert begin(place)["queued"] == 1


def test_batch_ignores_modification_time_of_recordings(place):
    os.utime(place / "in" / "a.mp4", (0, 0))
    assert begin(place)["done"] == 2


@pytest.mark.parametrize("content", [b"", b"[", b"[]", b"\xff", b"[" * 50_000])
def test_batch_refuses_damaged_recordings_json(place, content):
    (place / "out" / ".recordings.json").write_bytes(content)
    with pytest.raises(InvalidSetting, match="cannot be read"):
        begin(place)


@pytest.mark.parametrize(
    "names",
    [
        ["video.mp4", "masks/0.png"], ["video.mp4", "depth/0.png"], ["video.mp4", "recording.json"], ["images/0.png", "poses_bounds.npy"], ["images/0.png"],
        ["session.json", "segments/0"], ["cameras.json", "views/0.png"], ["video.mp4", "valid_mask.png"], ["left.mp4", "right.mp4"], ["video.mp4", "poses.npy"],
    ],
)  # fmt: skip
def test_recordings_in_refuses_folder_that_is_a_recording(tmp_path, names):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InvalidSetting, match="is a recording itself"):
        recordings_in(tmp_path)


@pytest.mark.parametrize("name", [b"\xff\xfe.mp4", b"a\nb.mp4", b"a\x1b[2J.mp4", b"\xc3.mkv"])
def test_recordings_in_lists_files_with_unprintable_names_as_unusable(tmp_path, name):
    for each in (b"good.mp4", name):
        with open(os.path.join(os.fsencode(tmp_path), each), "wb"):
            pass
    found, unusable = recordings_in(tmp_path)
    assert [path.name for path in found] == ["good.mp4"]
    assert [os.fsencode(name) for name, _ in unusable] == [name]


def test_recordings_in_returns_visible_folders_and_videos(tmp_path):
    for name in ("a", ".b", "A folder"):
        (tmp_path / name).mkdir()
    for name in ("c.mp4", "D.MKV", ".e.mp4", "notes.txt", ".f"):
        (tmp_path / name).touch()
    found, unusable = recordings_in(tmp_path)
    assert [path.name for path in found] == ["A folder", "D.MKV", "a", "c.mp4"] and unusable == []
    with pytest.raises(InvalidSetting, match="no videos and no folders"):
        recordings_in(tmp_path / "a")
    with pytest.raises(InvalidSetting, match="is no folder"):
        recordings_in(tmp_path / "c.mp4")


@pytest.mark.parametrize("depth", ["auto", *(name for name in DEPTHS if name != "onnx")])
def test_job_options_accept_registered_depths(depth):
    assert JobOptions(depth=depth).depth == CallerJobOptions(depth=depth).depth == depth


@pytest.mark.parametrize("depth", ["onnx", "onnx:", "nothing", "", "stereo:x", "auto:x", "ONNX:x", "light:"])
def test_job_options_refuse_unknown_depths(depth):
    for kind in (JobOptions, CallerJobOptions):
        with pytest.raises(InvalidSetting):
            kind(depth=depth)


def test_caller_job_options_require_absolute_path_of_onnx_file(tmp_path):
    assert JobOptions(depth="onnx:b.onnx").depth == "onnx:b.onnx", "a batch may name any local file"
    network = tmp_path / "depth.onnx"
    for missing in ("onnx:depth.onnx", f"onnx:{network}", "onnx:/etc/passwd"):
        with pytest.raises(InvalidSetting, match=r"absolute path|no file of the server that ends in \.onnx"):
            CallerJobOptions(depth=missing)
    network.write_bytes(b"")
    assert CallerJobOptions(depth=f"onnx:{network}").depth == f"onnx:{network}"


def test_caller_job_options_accept_estimated_poses():
    assert CallerJobOptions(poses="estimated").chosen() == {"poses": "estimated"}
    with pytest.raises(InvalidSetting):
        CallerJobOptions(poses="x")


def test_failed_new_batch_leaves_no_files(tmp_path, monkeypatch):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.mp4").write_bytes(b"a")

    def full(*_):
        raise StoreUnavailable("its disk is full; free space")

    monkeypatch.setattr(JobStore, "submit", full)
    with pytest.raises(StoreUnavailable):
        Batch(tmp_path / "in", tmp_path / "out", JobOptions())
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
    (tmp_path / "out").mkdir()
    with pytest.raises(StoreUnavailable):
        Batch(tmp_path / "in", tmp_path / "out", JobOptions())
    assert list((tmp_path / "out").iterdir()) == []


def test_failed_continued_batch_keeps_its_jobs(place, monkeypatch):
    def full(*_):
        raise StoreUnavailable("its disk is full; free space")

    (place / "in" / "c.mp4").write_bytes(b"c")
    with monkeypatch.context() as patch:
        patch.setattr(JobStore, "submit", full)
        with pytest.raises(StoreUnavailable):
            begin(place)
    assert begin(place)["done"] == 2
