"""Bad input: one error sentence, exit code 2, no traceback, and earlier results are kept."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import struct

import cv2
import numpy as np
import pytest

from operators.sinks.video import VideoFile
from services.reports.schema import RunReport

QUICK = ("--steps-per-frame", "2")


@pytest.fixture
def refused(intrasplat):
    """Return a function that runs a command and checks that it is refused with the given text."""

    def check(*arguments, match: str):
        done = intrasplat(*arguments)
        assert done.code == 2, done.err
        assert done.err.splitlines()[-1].startswith(("error: ", "  in operator ")), done.err
        assert "Traceback" not in done.err
        assert match in done.err, done.err
        return done

    return check


@pytest.fixture
def kept(finished, tmp_path, fingerprints):
    """A copy of a finished run that must be unchanged at the end of the test."""
    out = tmp_path / "kept"
    shutil.copytree(finished, out)
    before = fingerprints(out)
    yield out
    assert fingerprints(out) == before


@pytest.fixture
def copy(tiny, tmp_path):
    """A copy of the recording that the test may damage."""
    return shutil.copytree(tiny, tmp_path / "recording")


def test_commands_refuse_missing_recording(tmp_path, kept, refused):
    refused("replay", tmp_path / "nowhere", "--out", kept, match="no such file or folder")
    refused("validate", tmp_path / "nowhere", match="no such file or folder")
    refused("reconstruct", tmp_path / "nowhere", "--out", kept, match="no such file or folder")


def test_replay_refuses_truncated_video(tmp_path, kept, refused):
    with VideoFile(tmp_path / "video.mp4", 64, 48, 30.0) as video:
        for k in range(20):
            video.write(np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8))
    whole = (tmp_path / "video.mp4").read_bytes()
    (tmp_path / "video.mp4").write_bytes(whole[: len(whole) // 2])
    refused("replay", tmp_path / "video.mp4", "--out", kept, match="video.mp4")


def test_replay_with_broken_image_saves_earlier_frames(copy, tmp_path, refused):
    """The fault appears only during the run, which ends early with valid results."""
    broken = sorted((copy / "images").iterdir())[3]
    broken.write_bytes(broken.read_bytes()[:-200])
    out = tmp_path / "out"
    done = refused("replay", copy, "--out", out, *QUICK, match=broken.name)
    assert "in operator source" in done.err
    report = RunReport.read(out / "report.json")
    assert report.frames.displayed == 3 and broken.name in report.run.stop_reason
    assert cv2.VideoCapture(str(out / "reconstruction.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert (out / "model" / "model.safetensors").exists()
    assert 'role="alert"' in (out / "report.html").read_text()


def test_replay_refuses_masks_of_wrong_size(copy, kept, refused):
    for path in (copy / "masks").iterdir():
        cv2.imwrite(str(path), np.zeros((10, 12), np.uint8))
    refused("replay", copy, "--out", kept, match="mask")


def test_replay_refuses_recording_with_missing_mask(copy, kept, refused):
    sorted((copy / "masks").iterdir())[-1].unlink()
    refused("replay", copy, "--out", kept, match="5 masks for 6 frames")


def test_replay_refuses_inverted_masks(copy, kept, refused):
    for path in (copy / "masks").iterdir():
        cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    refused("replay", copy, "--out", kept, match="probably inverted")


def rewrite_tensors(bundle, change):
    """Change the bytes of the tensors and update the digest in the manifest."""
    path, manifest_path = bundle / "model.safetensors", bundle / "manifest.json"
    data = bytearray(path.read_bytes())
    (header,) = struct.unpack("<Q", data[:8])
    change(data, 8 + header)
    path.write_bytes(data)
    manifest = json.loads(manifest_path.read_text())
    manifest["tensors"]["sha256"] = hashlib.sha256(data).hexdigest()
    manifest_path.write_text(json.dumps(manifest))


@pytest.fixture
def bundle(finished, tmp_path):
    return shutil.copytree(finished / "model", tmp_path / "model")


@pytest.mark.slow
def test_render_refuses_model_with_nan(bundle, tmp_path, refused):
    rewrite_tensors(
        bundle, lambda data, start: data.__setitem__(slice(start, start + 4), struct.pack("<f", float("nan")))
    )
    refused("render", bundle, "--out", tmp_path / "v.mp4", match="NaN")
    assert not (tmp_path / "v.mp4").exists()


def test_render_refuses_model_with_wrong_digest(bundle, tmp_path, refused):
    data = bytearray((bundle / "model.safetensors").read_bytes())
    data[-1] ^= 1
    (bundle / "model.safetensors").write_bytes(data)
    refused("render", bundle, "--out", tmp_path / "v.mp4", match="SHA-256")


def test_render_refuses_model_of_newer_format(bundle, tmp_path, refused):
    manifest = json.loads((bundle / "manifest.json").read_text())
    (bundle / "manifest.json").write_text(json.dumps(manifest | {"format_version": 99}))
    refused("render", bundle, "--out", tmp_path / "v.mp4", match="format version 99")


def test_render_refuses_empty_model_folder(tmp_path, refused):
    (tmp_path / "model").mkdir()
    refused("render", tmp_path / "model", "--out", tmp_path / "v.mp4", match="missing")


def fill(folder, leave_bytes):
    """Fill the disk except for the given number of bytes."""
    ballast = folder / "ballast"
    with open(ballast, "ab") as file:
        os.posix_fallocate(file.fileno(), 0, shutil.disk_usage(folder).free - leave_bytes)
    return ballast


def test_replay_refuses_full_disk(small_disk, tiny, refused):
    fill(small_disk, 1 << 20)
    refused("replay", tiny, "--out", small_disk / "out", *QUICK, match="is full")


def test_replay_on_disk_that_fills_up_saves_earlier_frames(small_disk, tiny, refused, monkeypatch):
    """The disk fills up after three frames. Video, model and report of these frames are still written."""
    from operators.sinks.video import VideoSinkOp

    compute = VideoSinkOp.compute

    def filling(self, op_input, op_output, context):
        if self.displayed == 3:
            fill(small_disk, 6 << 20)
        compute(self, op_input, op_output, context)

    monkeypatch.setattr(VideoSinkOp, "compute", filling)
    out = small_disk / "out"
    refused("replay", tiny, "--out", out, *QUICK, match="free some space on that disk or choose another --out")
    report = RunReport.read(out / "report.json")
    assert report.frames.displayed == 3 and "is full" in report.run.stop_reason
    assert cv2.VideoCapture(str(out / "reconstruction.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert (out / "model" / "manifest.json").exists() and (out / "report.html").exists()


def test_replay_on_full_disk_keeps_earlier_run(small_disk, finished, tiny, refused, fingerprints):
    out = small_disk / "out"
    shutil.copytree(finished, out)
    before = fingerprints(out)
    fill(small_disk, 1 << 16)
    refused("replay", tiny, "--out", out, *QUICK, match="is full")
    refused("render", out / "model", "--out", out.parent / "v.mp4", match="is full")
    assert fingerprints(out) == before


def test_replay_of_single_frame_succeeds_with_notes(tiny, tmp_path, intrasplat):
    one = tmp_path / "one"
    (one / "images").mkdir(parents=True)
    shutil.copy(sorted((tiny / "images").iterdir())[0], one / "images" / "000000.png")
    done = intrasplat("replay", one, "--out", tmp_path / "out", "--heldout", *QUICK)
    assert done.code == 0, done.err
    assert "it has one frame" in done.err
    report = RunReport.read(tmp_path / "out" / "report.json")
    assert report.frames.displayed == 1
    assert report.quality.baselines.previous_frame_db is None
    assert report.quality.heldout.frames == 0
    assert "the recording has no depth" in " ".join(report.notes)


def test_replay_refuses_foreign_output_folder(tiny, tmp_path, refused):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    refused("replay", tiny, "--out", tmp_path / "thesis", match="not made by intrasplat")
    refused("replay", tiny, "--out", tiny, match="lies inside --out")
    assert [p.name for p in (tmp_path / "thesis").iterdir()] == ["chapter1.tex"]


def test_replay_refuses_cuda_without_gpu(tiny, tmp_path, refused, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    refused("replay", tiny, "--out", tmp_path / "out", "--device", "cuda", match="use --device cpu")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (("--scale", "0"), "scale is 0.0; it must be above 0 and at most 64"),
        (("--max-frames", "0"), "max_frames is 0; it must be from 1 to"),
        (("--steps-per-frame", "0"), "steps_per_frame is 0"),
        (("--seed", "-1"), "seed is -1"),
        (("--field", "fourier"), "field is 'fourier'; choose auto, basis or hexplane"),
        (("--engine", "steam"), "engine is 'steam'"),
        (("--device", "tpu"), "device is 'tpu'; choose cpu or cuda"),
    ],
)
def test_replay_refuses_invalid_options(tiny, tmp_path, refused, options, match):
    refused("replay", tiny, "--out", tmp_path / "out", *options, match=match)
    assert not (tmp_path / "out").exists()
