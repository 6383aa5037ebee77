"""The video file of a run: complete or absent, in real time, and close to the displayed pictures."""

from __future__ import annotations

import errno
import threading
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from operators.errors import OutputError, StorageFull
from operators.sinks.video import VideoFile
from operators.storage import StorageReserve


def _pictures(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    row, column = np.mgrid[:height, :width]
    planes = (column * 3, row * 4, column + row)
    return [np.stack([(plane + 5 * i) % 200 + 20 for plane in planes], axis=2).astype(np.uint8) for i in range(count)]


def _read(path: Path) -> list[tuple[float, np.ndarray]]:
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.codec.canonical_name == "vp9"
        return [(float(frame.time), frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]


@pytest.mark.parametrize("size", [(48, 64), (47, 63), (1, 1), (16, 500)])
def test_video_file_round_trip_preserves_frames_and_times(tmp_path: Path, size: tuple[int, int]) -> None:
    written = _pictures(6, *size)
    with VideoFile(tmp_path / "v.mp4", size[1], size[0], 25.0) as video:
        for image in written:
            video.write(image)
    read = _read(tmp_path / "v.mp4")
    assert [round(time, 4) for time, _ in read] == [0, 0.04, 0.08, 0.12, 0.16, 0.2]
    for (_, image), expected in zip(read, written, strict=True):
        assert image.shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
        assert np.abs(image[: size[0], : size[1]].astype(int) - expected).mean() < 12
    assert [path.name for path in tmp_path.iterdir()] == ["v.mp4"]


def test_video_file_times_follow_recording_and_increase(tmp_path: Path) -> None:
    with VideoFile(tmp_path / "v.mp4", 64, 48, 30.0) as video:
        for image, time_s in zip(_pictures(5), (0.0, 0.5, 0.5, 0.4, 2.0), strict=True):
            video.write(image, time_s)
    times = [time for time, _ in _read(tmp_path / "v.mp4")]
    assert times == pytest.approx([0, 0.5, 0.5, 0.5, 2.0], abs=1e-3)
    assert all(later > earlier for earlier, later in pairwise(times))


def test_video_file_without_frames_keeps_earlier_file(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"earlier")
    VideoFile(tmp_path / "v.mp4", 64, 48, 30.0).close()
    assert (tmp_path / "v.mp4").read_bytes() == b"earlier"
    video = VideoFile(tmp_path / "v.mp4", 64, 48, 30.0)
    video.write(_pictures(1)[0])
    assert (tmp_path / "v.mp4").read_bytes() == b"earlier"
    video.close()
    video.close()
    assert len(_read(tmp_path / "v.mp4")) == 1 and len(list(tmp_path.iterdir())) == 1


def test_video_file_refuses_wrong_size_and_full_disk(tmp_path: Path) -> None:
    with VideoFile(tmp_path / "v.mp4", 64, 48, 30.0) as video:
        video.write(_pictures(1)[0])
        with pytest.raises(OutputError, match=r"\[48, 60\]"):
            video.write(np.zeros((48, 60, 3), np.uint8))
    with pytest.raises(OutputError, match="100000x2"):
        VideoFile(tmp_path / "w.mp4", 100_000, 2, 30.0)
    with pytest.raises(StorageFull):
        VideoFile(tmp_path / "x.mp4", 64, 48, 30.0, StorageReserve(tmp_path, lambda: 2**62))
    assert [path.name for path in tmp_path.iterdir()] == ["v.mp4"]


def _fail_from(frame: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk be full from the coding of that frame on."""
    write = VideoFile._write
    calls = iter(range(1000))

    def full(self: VideoFile, picture: av.VideoFrame | None) -> None:
        with self._writing():
            if next(calls) >= frame:
                raise OSError(errno.ENOSPC, "No space left on device")
        write(self, picture)

    monkeypatch.setattr(VideoFile, "_write", full)


def _encoders() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("encode v.mp4")]


def test_video_file_raises_encoder_error_on_later_write_and_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _fail_from(1, monkeypatch)
    with (
        pytest.raises(StorageFull, match=r"the disk of .* is full"),
        VideoFile(tmp_path / "v.mp4", 64, 48, 30.0) as video,
    ):
        for image in _pictures(10):
            video.write(image)
    assert 2 <= video.frames < 10, "writing stops soon after it"
    assert list(tmp_path.iterdir()) == [] and _encoders() == []


def test_video_file_close_raises_encoder_error_of_last_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "v.mp4").write_bytes(b"earlier")
    _fail_from(0, monkeypatch)
    video = VideoFile(tmp_path / "v.mp4", 64, 48, 30.0)
    video.write(_pictures(1)[0])
    with pytest.raises(StorageFull, match=r"the disk of .* is full"):
        video.close()
    video.close()
    assert (tmp_path / "v.mp4").read_bytes() == b"earlier" and len(list(tmp_path.iterdir())) == 1
    assert _encoders() == []


def test_video_file_copies_written_picture(tmp_path: Path) -> None:
    picture = np.full((48, 64, 3), 200, np.uint8)
    with VideoFile(tmp_path / "v.mp4", 64, 48, 30.0) as video:
        for _ in range(4):
            video.write(picture)
            picture[...] = 0
            picture[...] = 200
        picture[...] = 0
    assert all(image.mean() > 190 for _, image in _read(tmp_path / "v.mp4"))
    assert _encoders() == []
