"""Video files and their sidecar files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Interpolation

from gsplat_core.errors import RecordingInvalid, RecordingMissing
from gsplat_core.io.recordings import Recording, open_recording, validate_recording
from gsplat_core.io.recordings.decoder import PictureConverter
from gsplat_core.scene.frames import FrameStatus
from tests.gsplat_core.io.recordings import videos

Refused = Callable[..., str]


def test_video_folder_frames_masks_and_poses(video_folder: Path, make: SimpleNamespace) -> None:
    recording = open_recording(video_folder)
    assert isinstance(recording, Recording)
    assert (recording.name, recording.frame_count, recording.width_px, recording.height_px) == ("rec", 8, 48, 40)
    assert recording.fps == 25
    assert recording.fields == {"mask", "pose"}
    assert recording.notes == ()
    assert recording.camera.K.tolist() == [[50, 0, 24], [0, 50, 20], [0, 0, 1]]
    frames = list(recording)
    assert [frame.seq for frame in frames] == list(range(8))
    assert [frame.pts_ns for frame in frames] == [index * 40_000_000 for index in range(8)]
    for index, frame in enumerate(frames):
        # Lossy, but the frames' red differs by 20.
        assert abs(float(frame.image[..., 0].mean()) - (20 * index + 10)) < 8
        assert np.abs(frame.image.astype(int) - make.frame_image(index)).mean() < 8
        assert frame.mask is not None and frame.mask[:, :12].max() == 0 and frame.mask[:, 12:].min() == 1
        assert frame.pose is not None and np.array_equal(frame.pose, np.eye(4))
        assert frame.status is FrameStatus.REPLAY


def test_recording_supports_parallel_iterators(video_folder: Path) -> None:
    recording = open_recording(video_folder)
    first, second = iter(recording), iter(recording)
    for a in first:
        b = next(second)
        assert a.seq == b.seq and np.array_equal(a.image, b.image)
    assert len(list(recording)) == 8


def test_bare_video_gets_a_stated_default_camera(video_folder: Path) -> None:
    recording = open_recording(video_folder / "video.mp4")
    assert recording.name == "video.mp4"
    assert recording.fields == frozenset()
    assert recording.camera.K[0, 0] == pytest.approx(0.9 * 48)
    assert "no calibration" in recording.notes[0] and "43.2 px" in recording.notes[0]
    frame = next(iter(recording))
    assert frame.pose is None and frame.mask is None
    assert recording.camera_at(7) == recording.camera


def test_single_video_of_any_name_is_found(video_folder: Path, refused: Refused, make: SimpleNamespace) -> None:
    (video_folder / "video.mp4").rename(video_folder / "scope.mp4")
    assert open_recording(video_folder).frame_count == 8
    make.video(video_folder / "room.mp4", 8)
    refused(video_folder, RecordingInvalid, "2 videos", "scope.mp4", "video.mp4")


@pytest.mark.parametrize(("codec", "suffix"), [("MJPG", ".avi"), ("VP80", ".webm")])
def test_containers_without_exact_frame_count(tmp_path: Path, make: SimpleNamespace, codec: str, suffix: str) -> None:
    make.video(tmp_path / f"v{suffix}", 7, codec=codec)
    recording = open_recording(tmp_path / f"v{suffix}")
    assert recording.frame_count == 7 == len(list(recording))


def times_ms(recording: Recording) -> list[float]:
    return [frame.pts_ns * 1e-6 for frame in recording]


@pytest.mark.parametrize(("ticks", "is_noted"), [([0, 1, 2, 50, 51, 900], True), ([0, 3, 6, 9, 12, 15], False)])
def test_video_frames_keep_timestamps_of_file(tmp_path: Path, ticks: list[int], is_noted: bool) -> None:
    videos.write_timed(tmp_path / "v.mkv", ticks)
    recording = open_recording(tmp_path / "v.mkv")
    assert [frame.pts_ns for frame in recording] == [tick * 40_000_000 for tick in ticks]
    assert any("0.04 to 34 s apart" in note for note in recording.notes) == is_noted


def test_even_timestamps_are_multiples_of_frame_duration(tmp_path: Path) -> None:
    """Matroska rounds times to milliseconds."""
    videos.write_timed(tmp_path / "v.mkv", [0, 1, 2, 3, 4, 5])
    recording = open_recording(tmp_path / "v.mkv")
    assert [frame.pts_ns for frame in recording] == [index * 40_000_000 for index in range(6)]
    assert not any("apart" in note for note in recording.notes)


VARIABLE_MS = [0, 33, 99, 132, 232, 265, 331, 364, 464]


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
@pytest.mark.parametrize("start_ms", [0, 5000])
def test_variable_frame_rate_keeps_timestamps_and_mean_rate(tmp_path: Path, suffix: str, start_ms: int) -> None:
    path = tmp_path / f"v{suffix}"
    videos.write_timed(path, [start_ms + time for time in VARIABLE_MS], 30, Fraction(1, 1000))
    recording = open_recording(path)
    assert times_ms(recording) == pytest.approx(VARIABLE_MS, abs=1e-6)
    assert recording.fps == pytest.approx(8 / 0.464)
    assert any("0.033 to 0.1 s apart. They keep their times" in note for note in recording.notes)
    assert times_ms(open_recording(path, max_frames=5)) == pytest.approx(VARIABLE_MS[:5], abs=1e-6)


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
@pytest.mark.parametrize(("off_ms", "is_kept"), [(8, True), (1, False)])
def test_uneven_timestamps_are_kept_unless_rounded_by_container(
    tmp_path: Path, suffix: str, off_ms: int, is_kept: bool
) -> None:
    even = [40 * index for index in range(9)]
    written = [time + off_ms * (index % 4 == 2) for index, time in enumerate(even)]
    recording = open_recording(videos.write_timed(tmp_path / f"v{suffix}", written, 25, Fraction(1, 1000)))
    assert times_ms(recording) == pytest.approx(written if is_kept else even, abs=1e-6)
    assert any("apart" in note for note in recording.notes) == is_kept


def test_repeated_times_before_a_pause_are_read_as_evenly_spaced(tmp_path: Path) -> None:
    path = videos.write_timed(tmp_path / "v.mkv", list(range(60)), 30, Fraction(1, 30))
    videos.set_times(path, [66 * (index // 2) for index in range(59)] + [20_000])
    recording = open_recording(path)
    assert [frame.pts_ns for frame in recording] == [round(k * 1e9 / 30) for k in range(60)]
    assert any("29 of its 60 frame times are repeated" in note for note in recording.notes)


def test_constant_rate_timestamps_are_restored_from_rounded_ones(tmp_path: Path) -> None:
    path = videos.write_timed(
        tmp_path / "v.mkv", [round(index * 1000 / 30) for index in range(12)], 30, Fraction(1, 1000)
    )
    recording = open_recording(path)
    assert (recording.fps, [frame.pts_ns for frame in recording]) == (30, [round(k * 1e9 / 30) for k in range(12)])
    assert not any("apart" in note for note in recording.notes)


def test_even_timestamps_override_wrong_stated_rate(tmp_path: Path) -> None:
    path = videos.write_timed(tmp_path / "v.mkv", [20 * index for index in range(12)], 25, Fraction(1, 1000))
    recording = open_recording(path)
    assert recording.fps == pytest.approx(50)
    assert times_ms(recording) == pytest.approx([20 * index for index in range(12)], abs=1e-6)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ([0, 40, 80, 80, 160, 200], "1 of its 6 frame times are repeated"),
        ([0] * 6, "5 of its 6 frame times are repeated"),
        ([0, 40, 120, 80, 160, 200], "its frame times go backwards 1 times"),
    ],
)
def test_non_increasing_timestamps_are_replaced_by_frame_rate(tmp_path: Path, changed: list[int], said: str) -> None:
    path = videos.write_timed(tmp_path / "v.mkv", list(range(6)))
    videos.set_times(path, changed)
    recording = open_recording(path)
    frames = list(recording)
    assert [frame.pts_ns for frame in frames] == [index * 40_000_000 for index in range(6)]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [20 * index for index in range(6)], "in file order"
    assert any(f"{said}. Its frames are taken as evenly spaced, at 25 frames/s" in note for note in recording.notes)


def test_stated_rate_does_not_change_variable_frame_times(tmp_path: Path) -> None:
    videos.write_timed(tmp_path / "video.mkv", VARIABLE_MS, 30, Fraction(1, 1000))
    (tmp_path / "recording.json").write_text(
        '{"format": "intrasplat-recording", "version": 1, "fps": 60}', encoding="utf-8"
    )
    recording = open_recording(tmp_path)
    assert times_ms(recording) == pytest.approx(VARIABLE_MS, abs=1e-6)
    assert any("states 60 frames/s, and the video has 17.24 frames/s on average" in note for note in recording.notes)


def test_video_longer_than_one_day_rejected(tmp_path: Path, refused: Refused) -> None:
    videos.write_timed(tmp_path / "v.mkv", [0, 1, 25 * 86_401])
    refused(tmp_path / "v.mkv", RecordingInvalid, "86401 s after the first one", "25 frames/s")


def test_pipe_and_broken_symlink_are_refused(tmp_path: Path, refused: Refused) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    refused(tmp_path / "pipe.mp4", RecordingMissing, "not a plain file")
    (tmp_path / "loop.mp4").symlink_to(tmp_path / "loop.mp4")
    refused(tmp_path / "loop.mp4", RecordingMissing, "symbolic links")
    (tmp_path / "lost.mp4").symlink_to(tmp_path / "nowhere.mp4")
    refused(tmp_path / "lost.mp4", RecordingMissing, "leads to nothing")


def test_open_recording_with_max_frames_and_scale(video_folder: Path) -> None:
    recording = open_recording(video_folder, scale=0.5, max_frames=3)
    frames = list(recording)
    assert len(frames) == recording.frame_count == 3
    assert frames[0].image.shape == (20, 24, 3)
    assert frames[0].mask is not None and set(np.unique(frames[0].mask)) == {0, 1}
    assert recording.camera.K.tolist() == [[25, 0, 12], [0, 25, 10], [0, 0, 1]]
    assert (recording.camera.width_px, recording.camera.height_px) == (24, 20)
    full = next(iter(open_recording(video_folder)))
    means = full.image.reshape(20, 2, 24, 2, 3).mean(axis=(1, 3))
    assert np.abs(frames[0].image - means).max() <= 1  # the area filter is the mean of 2 x 2 pixels


def test_open_recording_of_missing_path_is_refused(tmp_path: Path, refused: Refused) -> None:
    refused(tmp_path / "nowhere", RecordingMissing, "nowhere", "no such file or folder")


def test_open_recording_of_empty_folder_is_refused(tmp_path: Path, refused: Refused) -> None:
    refused(tmp_path, RecordingMissing, str(tmp_path), "the folder is empty")


def test_folder_without_recording_is_refused(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    refused(tmp_path, RecordingMissing, "notes.txt")


@pytest.mark.parametrize(
    ("format_name", "said"), [("mpegts", "an MPEG transport stream"), ("mpeg", "an MPEG program stream")]
)
def test_refused_video_formats_are_named(tmp_path: Path, refused: Refused, format_name: str, said: str) -> None:
    with av.open(str(tmp_path / "video.mp4"), "w", format=format_name) as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in range(4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 40 * level, np.uint8))))
        container.mux(stream.encode())
    refused(tmp_path, RecordingInvalid, f"the file is {said}", "re-encode it")


def test_text_file_named_mp4_is_refused(tmp_path: Path, refused: Refused, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "video.mp4").write_text("this is no video\n" * 50)
    refused(tmp_path, RecordingInvalid, "video.mp4", "is not a video", "this is no v")
    assert capfd.readouterr().err == ""


def test_empty_file_named_mp4_is_refused(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "video.mp4").touch()
    refused(tmp_path / "video.mp4", RecordingInvalid, "empty (0 bytes)")


def test_mp4_cut_in_half_is_refused(video_folder: Path, refused: Refused, capfd: pytest.CaptureFixture[str]) -> None:
    video = video_folder / "video.mp4"
    size = video.stat().st_size
    os.truncate(video, size // 2)
    refused(video_folder, RecordingInvalid, "video.mp4", "cut off", f"ends at byte {size // 2}")
    assert capfd.readouterr().err == ""


def test_mp4_without_index_is_refused(video_folder: Path, refused: Refused) -> None:
    video = video_folder / "video.mp4"
    os.truncate(video, video.read_bytes().index(b"moov") - 4)
    refused(video_folder, RecordingInvalid, "cut off", "index", "missing")


def test_avi_cut_in_half_is_refused(tmp_path: Path, make: SimpleNamespace, refused: Refused) -> None:
    make.video(tmp_path / "v.avi", 7, codec="MJPG")
    os.truncate(tmp_path / "v.avi", (tmp_path / "v.avi").stat().st_size // 2)
    refused(tmp_path / "v.avi", RecordingInvalid, "cut off")


def test_video_with_fewer_frames_than_announced_is_refused(video_folder: Path) -> None:
    """The container is complete and announces 8 frames, but its data stops making sense after some."""
    video = video_folder / "video.mp4"
    data = bytearray(video.read_bytes())
    begin, end = data.index(b"mdat") + 4, data.index(b"moov") - 4
    middle = (begin + end) // 2
    data[middle:end] = bytes(end - middle)
    video.write_bytes(data)
    recording = open_recording(video_folder)
    seen = []
    with pytest.raises(RecordingInvalid, match=r"ends early: \d of 8 announced frames") as caught:
        seen.extend(recording)
    assert 1 <= len(seen) < 8
    assert f"{len(seen)} of 8" in str(caught.value) and f"--max-frames {len(seen)}" in str(caught.value)
    assert str(caught.value) in [str(problem) for problem in validate_recording(video_folder).problems]
    # The advice holds.
    assert len(list(open_recording(video_folder, max_frames=len(seen)))) == len(seen)


def test_recording_digest_changes_with_content(video_folder: Path, tmp_path: Path) -> None:
    digest = open_recording(video_folder).digest
    assert len(digest) == 64
    shutil.copytree(video_folder, tmp_path / "copy")
    assert open_recording(tmp_path / "copy", scale=0.5).digest == digest
    poses = np.load(tmp_path / "copy" / "poses_bounds.npy")
    poses[3, 16] += 1
    np.save(tmp_path / "copy" / "poses_bounds.npy", poses)
    assert open_recording(tmp_path / "copy").digest != digest


def test_video_of_one_frame_is_accepted_with_note(tmp_path: Path, make: SimpleNamespace) -> None:
    make.video(tmp_path / "one.mp4", 1)
    recording = open_recording(tmp_path / "one.mp4")
    assert len(list(recording)) == 1
    assert any("one frame" in note for note in recording.notes)
    assert validate_recording(tmp_path / "one.mp4").ok


@pytest.mark.parametrize(
    "arguments", [{"scale": 0}, {"scale": float("nan")}, {"scale": float("inf")}, {"max_frames": 0}]
)
def test_open_recording_refuses_invalid_arguments(video_folder: Path, arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(arguments))):
        open_recording(video_folder, **arguments)


def test_camera_at_refuses_frame_out_of_range(video_folder: Path) -> None:
    with pytest.raises(ValueError, match="frame 8 is not in the recording"):
        open_recording(video_folder).camera_at(8)


def test_picture_converter_reuse_equals_separate_conversions(
    rng: np.random.Generator,
) -> None:
    shared = PictureConverter()
    for size in ((64, 48), (33, 17), (64, 48)):
        for pixels in ("yuv420p", "yuvj420p", "yuv422p", "yuv444p", "gray", "rgb24"):
            frame = av.VideoFrame(*size, pixels)
            for plane in frame.planes:
                plane.update(rng.integers(0, 256, plane.buffer_size, dtype=np.uint8).tobytes())
            alone = frame.to_ndarray(format="bgr24", interpolation=Interpolation.BICUBIC)[..., ::-1]
            assert np.array_equal(shared.picture(frame), alone), (size, pixels)


def _video_with(path: Path, streams: int = 1, pixel_shape: Fraction | None = None, options: str = "") -> Path:
    with av.open(str(path), "w") as container:
        encoders = [container.add_stream("libx264", rate=25, options={"x264-params": options}) for _ in range(streams)]
        for encoder in encoders:
            encoder.width, encoder.height, encoder.pix_fmt = 48, 40, "yuv420p"
            if pixel_shape is not None:
                encoder.codec_context.sample_aspect_ratio = pixel_shape
        for encoder in encoders:
            for image in videos.pictures(4, (48, 40)):
                container.mux(encoder.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(encoder.encode(None))
    return path


@pytest.mark.parametrize(
    ("settings", "noted"),
    [
        ({}, None),
        ({"pixel_shape": Fraction(1000, 1001)}, None),
        ({"pixel_shape": Fraction(16, 15)}, "not square: 16:15"),
        ({"options": "interlaced=1:tff=1"}, "interlaced"),
        ({"streams": 2}, "holds 2 videos"),
    ],
)
def test_unusual_video_format_is_noted(tmp_path: Path, settings: dict[str, Any], noted: str | None) -> None:
    notes = open_recording(_video_with(tmp_path / "v.mkv", **settings)).notes
    for fragment in ("not square", "interlaced", "videos"):
        assert any(fragment in note for note in notes) == (noted is not None and fragment in noted)
    assert noted is None or any(noted in note for note in notes)
