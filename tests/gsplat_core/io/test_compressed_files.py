"""Compressed `.ply` and `.spz`, against bytes laid out here by hand, and hostile files."""

import ctypes
import gzip
import itertools
import struct
import zlib

import numpy as np
import pytest
import torch

from gsplat_core.errors import BundleCorrupt, BundleError, ExportError
from gsplat_core.io import spz
from gsplat_core.io.exports.export import with_unit_rotations
from gsplat_core.io.ply import BOUNDS, compressed_ply_pieces, load_ply, morton_order
from gsplat_core.io.spz import library, load_spz, spz_pieces
from gsplat_core.reference.projection import spherical_harmonics_bases
from gsplat_core.scene.gaussians import SH_C0, Gaussians


def cloud(count, degree=0, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator)
    return with_unit_rotations(
        Gaussians(
            5 * draw(count, 3),
            draw(count, 4),
            draw(count, 3) * 0.5 - 3,
            2 * draw(count),
            0.3 * draw(count, (degree + 1) ** 2, 3),
        )
    )


def angle_between(first, second):
    """Angles of the rotations between two sets of unit quaternions, in degrees."""
    first, second = (q / q.norm(dim=1, keepdim=True) for q in (first, second))
    return torch.rad2deg(2 * torch.arccos((first * second).sum(1).abs().clamp(max=1)))


def compressed_header(chunks, count, bounds=tuple(BOUNDS), rest=0):
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in bounds]
    lines += [f"element vertex {count}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    return "\n".join([*lines, "end_header", ""]).encode()


LOW_HIGH = [-1, -2, -3, 1, 2, 3, -5, -5, -5, -1, -1, -1, 0, 0, 0, 1, 0.5, 1]
ONE_ROW = struct.pack("<4I", 2047 << 21 | 0 << 11 | 2047, 3 << 30 | 512 << 20, 0, 255 << 24 | 255 << 16 | 0 << 8 | 51)


def test_compressed_ply_of_handwritten_bytes_is_read(tmp_path):
    sh = bytes([0, 255, 128, 0, 0, 0, 0, 0, 0])
    (tmp_path / "a.ply").write_bytes(compressed_header(1, 1, rest=9) + struct.pack("<18f", *LOW_HIGH) + ONE_ROW + sh)
    seen = load_ply(tmp_path / "a.ply")
    assert seen.means.tolist() == [[1.0, -2.0, 3.0]]
    assert seen.log_scales.tolist() == [[-5.0, -5.0, -5.0]]
    # The largest component is the last one, z. The first of the others, w, is 512 of 1023.
    w = (512 / 1023 - 0.5) * 2**0.5
    least = -0.5 * 2**0.5
    assert torch.allclose(seen.quats, torch.tensor([[w, least, least, max(0, 1 - w * w - 1) ** 0.5]]), atol=1e-6)
    assert torch.allclose(seen.sh[0, 0] * SH_C0 + 0.5, torch.tensor([1.0, 0.5, 0.0]), atol=1e-6)
    assert torch.sigmoid(seen.logit_opacities).item() == pytest.approx(0.2)
    # Channel-major: red has the coefficients 0, 255 and 128.
    assert torch.allclose(seen.sh[0, 1:, 0], torch.tensor([-4.0, 4.0, 0.5 / 256 * 8]))
    assert seen.sh[0, 1:, 1:].unique().tolist() == [-4.0]


def test_compressed_ply_without_colour_bounds_uses_0_to_1(tmp_path):
    header = compressed_header(1, 1, BOUNDS[:12])
    (tmp_path / "a.ply").write_bytes(header + struct.pack("<12f", *LOW_HIGH[:12]) + ONE_ROW)
    assert torch.allclose(load_ply(tmp_path / "a.ply").sh[0, 0] * SH_C0 + 0.5, torch.tensor([1.0, 1.0, 0.0]))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 256, 700])
def test_compressed_ply_round_trip_errs_at_most_one_step(tmp_path, count, degree):
    wanted = cloud(count, degree)
    (tmp_path / "a.ply").write_bytes(b"".join(compressed_ply_pieces(wanted)))
    seen = load_ply(tmp_path / "a.ply")
    wanted = wanted.select(torch.from_numpy(morton_order(wanted.means.numpy())))
    spread = (wanted.means.amax(0) - wanted.means.amin(0)).clamp(min=1e-6)
    assert ((seen.means - wanted.means).abs() <= spread / 1023 * 0.51 + 1e-6).all()
    assert (seen.log_scales - wanted.log_scales).abs().max() < 4 / 1023
    assert angle_between(seen.quats, wanted.quats).max() < 0.2
    assert (seen.opacities - wanted.opacities).abs().max() <= 0.51 / 255
    assert (seen.sh[:, 0] - wanted.sh[:, 0]).abs().max() < 2.5 / 255 / SH_C0
    assert (seen.sh[:, 1:] - wanted.sh[:, 1:]).abs().amax() <= 4 / 256 + 1e-6 if degree else True


def spz_file(count=1, version=3, degree=0, fraction=12, body=None, magic=b"NGSP"):
    rotation = 3 if version == 2 else 4
    higher = 3 * ((degree + 1) ** 2 - 1)
    body = bytes(count * (16 + rotation + higher)) if body is None else body
    return gzip.compress(struct.pack("<4sIIBBBB", magic, version, count, degree, fraction, 0, 0) + body)


def compressed(data: bytes) -> bytes:
    """Compress by the same library, in one call."""
    found = library()
    found.ZSTD_compressBound.restype = found.ZSTD_compress.restype = ctypes.c_size_t
    found.ZSTD_compressBound.argtypes = [ctypes.c_size_t]
    found.ZSTD_compress.argtypes = [ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_int]
    target = ctypes.create_string_buffer(found.ZSTD_compressBound(len(data)))
    size = found.ZSTD_compress(target, len(target), data, len(data), 3)
    return target.raw[:size]


def spz_4(version_3: bytes, version=4, extension=b"", streams=None, plain=None) -> bytes:
    """Lay out a file of version 4 with the arrays of one of version 3."""
    whole = zlib.decompress(version_3, 31)
    _, _, count, degree, fraction, _, _ = struct.unpack("<4sIIBBBB", whole[:16])
    widths = [9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)]
    ends = np.cumsum([16, *(count * width for width in widths)])
    arrays = [whole[first:last] for first, last in itertools.pairwise(ends)]
    packed = [compressed(each) for each in arrays] if streams is None else streams
    table = 32 + len(extension)
    header = struct.pack(
        "<4sIIBBBBI12x", b"NGSP", version, count, degree, fraction, 2 if extension else 0, len(packed), table
    )
    plain = [len(each) for each in arrays] if plain is None else plain
    sizes = [struct.pack("<QQ", len(few), much) for few, much in zip(packed, plain, strict=True)]
    return header + extension + b"".join(sizes) + b"".join(packed)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("extension", [b"", b"\1\0\0\0\4\0\0\0abcd"])
def test_spz_version_4_equals_version_3_content(tmp_path, degree, extension):
    version_3 = b"".join(spz_pieces(cloud(500, degree)))
    (tmp_path / "3.spz").write_bytes(version_3)
    (tmp_path / "4.spz").write_bytes(spz_4(version_3, extension=extension))
    wanted, seen = (load_spz(tmp_path / name).tensors() for name in ("3.spz", "4.spz"))
    assert all(torch.equal(seen[name], wanted[name]) for name in wanted)


def four(**changes) -> bytes:
    return spz_4(b"".join(spz_pieces(cloud(40, 0))), **changes)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: four(version=5), "version 5; versions 2 to 4"),
        (lambda: four()[:20], "cut short"),
        (lambda: four()[:50], "cut short"),
        (lambda: four()[:-1], "cut short"),
        (lambda: four(plain=[1 << 50, 40, 120, 120, 160, 0]), "other sizes"),
        (lambda: four(plain=[360, 40, 120, 120, 161, 0]), "other sizes"),
        (lambda: four(streams=[compressed(bytes(n)) for n in (360, 40, 120, 120, 161, 0)]), "more bytes in a stream"),
        (lambda: four(streams=[compressed(bytes(n)) for n in (360, 40, 120, 120, 159, 0)]), "cut short"),
        (lambda: four(streams=[bytes(60)] * 6), "damaged Zstandard"),
        (lambda: four(streams=[b""] * 6), "cut short"),
    ],
)  # fmt: skip
def test_malformed_spz_version_4_is_refused(tmp_path, make, reason):
    path = tmp_path / "a.spz"
    path.write_bytes(make())
    with pytest.raises(BundleCorrupt, match=reason) as raised:
        load_spz(path)
    assert str(path) in str(raised.value)


def test_spz_version_4_without_zstd_names_package(tmp_path, monkeypatch):
    (tmp_path / "a.spz").write_bytes(four())
    monkeypatch.setattr(spz, "NAMES", ("libnothing.so.1",))
    spz.library.cache_clear()
    with pytest.raises(BundleError, match="install the package libzstd1"):
        load_spz(tmp_path / "a.spz")
    spz.library.cache_clear()


def test_spz_of_handwritten_bytes_is_read(tmp_path):
    position = (4096).to_bytes(3, "little") + (-8192).to_bytes(3, "little", signed=True) + bytes(3)
    # Version 3: the largest of x, y, z, w is w (3). x is -255 of 511, y and z are 0.
    rotation = struct.pack("<I", 3 << 30 | (512 | 255) << 20)
    sh = bytes([128 + 64, 128, 128] + [128, 0, 128] + [128, 128, 255])
    body = position + bytes([51]) + bytes([255, 0, 128]) + bytes([160, 176, 0]) + rotation + sh
    (tmp_path / "a.spz").write_bytes(spz_file(degree=1, body=body))
    seen = load_spz(tmp_path / "a.spz")
    assert seen.means.tolist() == [[1.0, 2.0, 0.0]]  # y and z change their signs
    assert torch.sigmoid(seen.logit_opacities).item() == pytest.approx(0.2)
    assert torch.allclose(seen.sh[0, 0], torch.tensor([0.5, -0.5, 0.5 / 255]) / 0.15, atol=1e-5)
    assert seen.log_scales.tolist() == [[0.0, 1.0, -10.0]]
    x = 0.5**0.5 * 255 / 511
    assert torch.allclose(seen.quats, torch.tensor([[(1 - x * x) ** 0.5, -x, 0.0, 0.0]]), atol=1e-6)
    # The functions of degree 1 are y, z and x. Channels are innermost.
    assert torch.allclose(seen.sh[0, 1:], torch.tensor([[-0.5, 0, 0], [0, 1.0, 0], [0, 0, 127 / 128]]))


def test_spz_version_2_rotations_have_three_bytes(tmp_path):
    body = bytes(9) + bytes([128, 128, 128, 128]) + bytes([160] * 3) + bytes([255, 128, 127])
    (tmp_path / "a.spz").write_bytes(spz_file(version=2, body=body))
    assert torch.allclose(load_spz(tmp_path / "a.spz").quats, torch.tensor([[0.0, 1.0, 0.0, 0.0]]), atol=0.01)


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_round_trip_errs_at_most_one_step(tmp_path, degree, version):
    wanted = cloud(500, degree)
    (tmp_path / "a.spz").write_bytes(b"".join(spz_pieces(wanted, version)))
    assert zlib.decompress((tmp_path / "a.spz").read_bytes(), 31)[:4] == b"NGSP"
    seen = load_spz(tmp_path / "a.spz")
    assert (seen.means - wanted.means).abs().max() < 2e-5
    assert (seen.log_scales - wanted.log_scales).abs().max() <= 0.51 / 16
    angles = angle_between(seen.quats, wanted.quats)
    # Version 2 derives w from rounded x, y and z, which is inexact near half turns.
    assert angles.max() < (0.25 if version == 3 else 18)
    assert angles.median() < (0.12 if version == 3 else 1)
    assert (seen.opacities - wanted.opacities).abs().max() <= 0.51 / 255
    assert (seen.sh[:, 0] - wanted.sh[:, 0]).abs().max() <= 0.51 / 255 / 0.15
    assert (seen.sh[:, 1:] - wanted.sh[:, 1:].clamp(-1, 1)).abs().amax() < 9 / 128 if degree else True


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_spz_axis_change_turns_spherical_harmonics(degree):
    """A Gaussian seen along d has the colour of the turned Gaussian along the turned d."""
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator, dtype=torch.float64), dim=1)
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    basis, of_turned = (spherical_harmonics_bases(degree, each) for each in (directions, turned))
    signs = torch.from_numpy(spz._signs((degree + 1) ** 2 - 1))[:, 0].double()
    assert torch.allclose(of_turned[:, 1:], basis[:, 1:] * signs, atol=1e-12)


def test_spz_position_precision_depends_on_farthest_gaussian(tmp_path):
    far = cloud(20)
    far.means[0, 1] = 300_000.0
    (tmp_path / "a.spz").write_bytes(b"".join(spz_pieces(far)))
    assert (load_spz(tmp_path / "a.spz").means - far.means).abs().max() <= 1 / 32 + 1e-6
    far.means[0, 1] = 1e7
    with pytest.raises(ExportError, match="from the origin"):
        b"".join(spz_pieces(far))


@pytest.mark.parametrize("pieces", [spz_pieces, compressed_ply_pieces])
def test_compressed_formats_refuse_sh_degree_4(pieces):
    with pytest.raises(ExportError, match="degree 4"):
        b"".join(pieces(cloud(3, 4)))


GOOD_PLY = compressed_header(1, 1) + struct.pack("<18f", *LOW_HIGH) + ONE_ROW


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda b: b[:-1], "cut short"),
        (lambda b: b.replace(b"chunk 1", b"chunk 2"), "cut short"),
        (lambda b: b.replace(b"chunk 1", b"chunk 0"), "0 chunks for 1 Gaussians"),
        (lambda b: b.replace(b"vertex 1", b"vertex 4000000000"), "cut short"),
        (lambda b: b.replace(b"min_scale_y", b"min_scale_w"), "bounds of a compressed ply"),
        (lambda b: b.replace(b"packed_color", b"packed_paint"), "packed_paint"),
        (lambda b: b.replace(b"uint packed_scale", b"float packed_scale"), "packed_scale"),
        (lambda b: b.replace(b"element vertex", b"element vertices"), "unexpected line"),
        (lambda b: b.replace(struct.pack("<f", -5.0), struct.pack("<f", float("nan"))), "3 bounds"),
        (lambda b: b.replace(b"end_header", b"element sh 1\nproperty uchar f_rest_0\nend_header") + b"\0", "1 properties"),
    ],
)  # fmt: skip
def test_malformed_compressed_ply_is_refused(change, reason, tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(change(GOOD_PLY))
    with pytest.raises(BundleCorrupt, match=reason) as raised:
        load_ply(path)
    assert str(path) in str(raised.value)


def _flipped(data):
    """Change the last byte of the checksum."""
    return data[:-8] + bytes([data[-8] ^ 1]) + data[-7:]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "gzip"),
        (b"ply\n", "gzip"),
        (b"NGSP" + bytes(100), "version 0; versions 2 to 4"),
        (b"NGSP\3" + bytes(100), "version 3 that is not compressed"),
        (b"\x1f\x8b\x08\x00", "cut short"),
        (gzip.compress(b"NG"), "cut short"),
        (spz_file(magic=b"PSNG"), "PSNG"),
        (spz_file(version=1), "version 1"),
        (spz_file(version=9), "version 9"),
        (spz_file(degree=5, body=b""), "degree 5"),
        (spz_file(fraction=40), "40 fractional"),
        (spz_file(count=2**32 - 1, body=b""), "cut short"),
        (spz_file(count=500, body=bytes(500 * 20 - 1)), "cut short"),
        (spz_file(count=500)[:-12], "cut short"),
        (_flipped(spz_file(count=500)), "damaged"),
    ],
)
def test_malformed_spz_is_refused(data, reason, tmp_path):
    path = tmp_path / "a.spz"
    path.write_bytes(data)
    with pytest.raises(BundleCorrupt, match=reason) as raised:
        load_spz(path)
    assert str(path) in str(raised.value)


def test_spz_gzip_bomb_is_refused(tmp_path, monkeypatch):
    """Three million Gaussians of zeros take 60 kB, and more memory than there is."""
    path = tmp_path / "a.spz"
    path.write_bytes(spz_file(count=3_000_000))
    assert path.stat().st_size < 100_000
    monkeypatch.setattr("gsplat_core.io.model_files.available_bytes", lambda: 50_000_000)
    with pytest.raises(BundleError, match="of memory to load"):
        load_spz(path)


@pytest.mark.parametrize("name", ["a.ply", "a.spz"])
def test_damaged_ply_or_spz_raises_only_bundle_error(name, tmp_path):
    pieces = compressed_ply_pieces(cloud(40, 1)) if name == "a.ply" else spz_pieces(cloud(40, 1))
    good, path = b"".join(pieces), tmp_path / name
    load = load_ply if name == "a.ply" else load_spz
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        data = bytearray(good[: generator.integers(1, len(good) + 1)] if generator.random() < 0.3 else good)
        for at in generator.integers(0, len(data), generator.integers(1, 4)):
            data[at] = generator.integers(256)
        path.write_bytes(data)
        try:
            seen = load(path)
        except BundleError as error:
            refused += 1
            assert str(path) in str(error)
        else:
            assert all(tensor.isfinite().all() for tensor in seen.tensors().values())
    assert refused > 50
