"""Files that this program wrote are recognised by their marks, and no others."""

from __future__ import annotations

import json
import struct
import tarfile
import zipfile

import numpy as np
import pytest

from gsplat_core.io.exports.export import TIMES_FILE
from gsplat_core.io.exports.files import ROW
from gsplat_core.io.ply import MARK_LINE
from gsplat_core.io.recordings.calibration import TRAILER
from operators.output_folder import is_own_file
from operators.sinks.video import VideoFile


def glb(magic=b"glTF", kind=b"JSON", generator="IntraSplat", length=None):
    content = json.dumps({"asset": {"generator": generator}}).encode()
    length = len(content) if length is None else length
    return struct.pack("<4sIII4s", magic, 2, 0, length, kind) + content


def splat(**fields):
    row = np.zeros(2, ROW)
    row["scale"] = 0.5
    for name, value in fields.items():
        row[name][1] = value
    return row.tobytes()


MARK = MARK_LINE.encode()
CASES = {
    "a.ply": ([b"ply\n" + MARK + b"\nend_header\n", b"ply\nformat\ncomment x\n" + MARK + b"\n"],
              [b"ply\nend_header\n", b"a\nb\nc\nd\n" + MARK + b"\n", b"x" * 512 + b"\n" + MARK + b"\n"]),
    "a.glb": ([glb()], [glb(b"glTX"), glb(kind=b"BIN\0"), glb(generator="Blender"), glb(length=(64 << 20) + 1), b"glTF", glb(length=3)]),
    "a.npy": ([b"\x93NUMPY" + b"x" * 99 + TRAILER], [b"\x93NUMPX" + TRAILER, b"\x93NUMPY" + b"x" * 99, b"\x93NUMPY"]),
    "a.splat": ([splat(), splat(scale=0.0)],
                [b"", splat()[:-1], splat(position=np.nan), splat(scale=np.inf), splat(scale=-0.1), splat() + b"x"]),
    "a.html": ([b"<!doctype html><title>IntraSplat</title>", b"<!doctype html>".ljust(4086) + b"IntraSplat"],
               [b"<html>IntraSplat", b"<!doctype html><p>", b"<!doctype html>".ljust(4087) + b"IntraSplat"]),
    "a.json": ([b'{"series": 1, "outputs": 2, "notes": 3, "more": 4}'], [b'{"series": 1, "outputs": 2}', b"[]", b"{", b'["series", "outputs", "notes"]']),
    "a.jsonl": ([b'{"seq": 1, "psnr_tissue_db": 2}\nbroken'], [b'{"seq": 1}\n', b"", b"[1]\n", b'["seq", "psnr_tissue_db"]\n']),
    "a.PLY": ([b"ply\n" + MARK + b"\n"], [b"ply\n"]),
    "a.txt": ([], [b"IntraSplat"]),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_is_own_file_by_mark_in_each_format(tmp_path, name):
    own, others = CASES[name]
    path = tmp_path / name
    assert not is_own_file(path)
    for data, ours in [*((data, True) for data in own), *((data, False) for data in others)]:
        path.write_bytes(data)
        assert is_own_file(path) is ours, data[:60]


@pytest.mark.parametrize(
    ("names", "ours"),
    [([TIMES_FILE, "0000.ply"], True), ([TIMES_FILE, "0000.ply", "0001.ply"], True), ([TIMES_FILE], False), (["0000.ply", TIMES_FILE], False)],
)  # fmt: skip
def test_is_own_file_for_ply_sequence_requires_times_first(tmp_path, names, ours):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in names:
            archive.writestr(name, "")
    assert is_own_file(tmp_path / "a.zip") is ours


@pytest.mark.parametrize(("first", "ours"), [("manifest.json", True), ("other.json", False)])
def test_is_own_file_for_packed_model_requires_manifest_first(tmp_path, first, ours):
    (tmp_path / "file").write_text("{}")
    with tarfile.open(tmp_path / "a.isplat", "w", format=tarfile.USTAR_FORMAT) as archive:
        archive.add(tmp_path / "file", first)
    assert is_own_file(tmp_path / "a.isplat") is ours
    (tmp_path / "b.isplat").write_bytes(b"manifest.json".ljust(512, b"\0"))
    assert not is_own_file(tmp_path / "b.isplat")


def test_is_own_file_for_video_by_comment(tmp_path):
    import av

    with VideoFile(tmp_path / "own.mp4", 16, 16, 25.0) as video:
        video.write(np.zeros((16, 16, 3), np.uint8))
    assert is_own_file(tmp_path / "own.mp4")
    with av.open(tmp_path / "own.mp4") as given, av.open(tmp_path / "other.mp4", "w") as other:
        stream = other.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                other.mux(packet)
    assert not is_own_file(tmp_path / "other.mp4")
    (tmp_path / "none.mp4").write_bytes(b"none")
    assert not is_own_file(tmp_path / "none.mp4")


def test_is_own_file_is_false_for_folder(tmp_path):
    (tmp_path / "folder.json").mkdir()
    assert not is_own_file(tmp_path / "folder.json")
