"""`.ply` in the INRIA layout, against files laid out here byte by byte."""

import struct

import pytest
import torch

from gsplat_core.errors import BundleCorrupt
from gsplat_core.io.ply import load_ply, save_ply
from gsplat_core.scene.gaussians import Gaussians

HEADER_START = b"ply\nformat binary_little_endian 1.0\ncomment written by IntraSplat\nelement vertex 2\n"
DEGREE_1 = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(9)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def header(names, start=HEADER_START):
    return start + b"".join(b"property float %s\n" % name.encode() for name in names) + b"end_header\n"


def two_gaussians():
    """Gaussian i has value 100 i + (number of the property), normals left out of the count."""
    base = torch.tensor([0.0, 100.0])[:, None]
    column = lambda *numbers: base + torch.tensor(numbers, dtype=torch.float32)
    # f_rest is channel-major: red 6 7 8, green 9 10 11, blue 12 13 14.
    sh = torch.stack([column(3, 4, 5), column(6, 9, 12), column(7, 10, 13), column(8, 11, 14)], dim=1)
    return Gaussians(
        means=column(0, 1, 2), quats=column(19, 20, 21, 22), log_scales=column(16, 17, 18),
        logit_opacities=column(15)[:, 0], sh=sh,
    )  # fmt: skip


def two_rows():
    rows = []
    for i in range(2):
        values = [100.0 * i + number for number in range(23)]
        rows.append(struct.pack("<26f", *values[:3], 0.0, 0.0, 0.0, *values[3:]))
    return b"".join(rows)


def assert_same(seen, wanted):
    for name, tensor in wanted.tensors().items():
        assert torch.equal(getattr(seen, name), tensor), name


def test_save_ply_writes_inria_layout(tmp_path):
    save_ply(two_gaussians(), tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes() == header(DEGREE_1) + two_rows()
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_load_ply_of_handwritten_bytes(tmp_path):
    (tmp_path / "a.ply").write_bytes(header(DEGREE_1) + two_rows())
    assert_same(load_ply(tmp_path / "a.ply"), two_gaussians())


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 33])
def test_ply_round_trip_is_exact(degree, count, make_gaussians, tmp_path):
    gaussians = make_gaussians(count, sh_degree=degree)
    save_ply(gaussians, tmp_path / "a.ply")
    assert_same(load_ply(tmp_path / "a.ply"), gaussians)


def test_load_ply_ignores_other_properties_and_elements(tmp_path):
    names = ["opacity", "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    start = (
        HEADER_START.replace(b"vertex 2", b"vertex 1")
        + b"comment made by hand\nproperty uchar red\nproperty double label\n"
    )
    text = header(names, start).replace(b"end_header", b"element face 1\nproperty list uchar int indices\nend_header")
    (tmp_path / "a.ply").write_bytes(text + struct.pack("<Bd14f", 7, 8.0, *range(14)) + b"\x03" + bytes(12))
    seen = load_ply(tmp_path / "a.ply")
    assert seen.logit_opacities.tolist() == [0.0]
    assert seen.means.tolist() == [[1.0, 2.0, 3.0]]
    assert seen.sh.tolist() == [[[4.0, 5.0, 6.0]]]
    assert seen.quats.tolist() == [[10.0, 11.0, 12.0, 13.0]]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda b: b"", "end_header"),
        (lambda b: b"\x00" * 70_000, "end_header"),
        (lambda b: b.replace(b"ply\n", b"obj\n", 1), "expected 'ply'"),
        (lambda b: b.replace(b"binary_little_endian", b"ascii"), "ascii"),
        (lambda b: b.replace(b"binary_little_endian", b"binary_big_endian"), "big_endian"),
        (lambda b: b.replace(b"vertex 2", b"vertex -2"), "vertex -2"),
        (lambda b: b.replace(b"vertex 2", b"vertex 99999999999999"), "vertex 9999"),
        (lambda b: b.replace(b"vertex 2", b"vertex 4000000000"), "cut short"),
        (lambda b: b.replace(b"element vertex 2\n", b""), "unexpected line"),
        (lambda b: b.replace(b"element vertex", b"element face"), "unexpected line"),
        (lambda b: b.replace(b"float x", b"quad x"), "quad x"),
        (lambda b: b.replace(b"property float x", b"property list uchar int x"), "list"),
        (lambda b: b.replace(b"float opacity", b"float opaque"), "no property opacity"),
        (lambda b: b.replace(b"f_rest_8", b"f_bare_8"), "8 f_rest"),
        (lambda b: b.replace(b"f_rest_8", b"f_rest_9"), "f_rest_8"),
        (lambda b: b.replace(b"float ny", b"float nx"), "twice"),
        (lambda b: b.replace(b"float nx", b"float \xff"), "ASCII"),
        (lambda b: b[:-1], "cut short"),
        (lambda b: b[:-4] + struct.pack("<f", float("nan")), "rot_3 holds 1 of 2"),
    ],
)
def test_malformed_ply_is_refused(change, reason, tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(change(header(DEGREE_1) + two_rows()))
    with pytest.raises(BundleCorrupt, match=reason) as raised:
        load_ply(path)
    assert str(path) in str(raised.value)


def test_failed_save_ply_keeps_old_file(make_gaussians, tmp_path, monkeypatch):
    from gsplat_core.io import files

    path = tmp_path / "a.ply"
    save_ply(make_gaussians(3), path)
    before = path.read_bytes()

    def full_disk(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_ply(make_gaussians(5), path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.ply"]
