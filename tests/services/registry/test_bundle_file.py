"""The upload format: lossless round trip, compatibility with tar, reproducible bytes."""

import io
import shutil
import subprocess
import tarfile

import pytest

from gsplat_core.io import bundle
from services.errors import Rejected
from services.registry import bundle_file
from services.registry.bundle_file import MANIFEST, TENSORS, members_of, pack, unpack
from tests.services.registry.made import save_model


def unpacked(file, folder):
    folder.mkdir()
    with open(file, "rb") as source:
        unpack(source, file.stat().st_size, folder)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def contents(model):
    return {name: (model / name).read_bytes() for name in (MANIFEST, TENSORS)}


def test_bundle_file_names_and_limits_match_bundle():
    assert (MANIFEST, TENSORS) == (bundle.MANIFEST, bundle.TENSORS)
    assert bundle_file.MOST_MANIFEST_BYTES == bundle.MAX_MANIFEST_BYTES


def test_pack_and_unpack_round_trip_is_byte_identical(tmp_path):
    model = save_model(tmp_path / "model")
    size = pack(model, tmp_path / "a.isplat")
    assert size == (tmp_path / "a.isplat").stat().st_size
    assert unpacked(tmp_path / "a.isplat", tmp_path / "b") == contents(model)
    pack(tmp_path / "b", tmp_path / "b.isplat")
    assert (tmp_path / "a.isplat").read_bytes() == (tmp_path / "b.isplat").read_bytes()


def test_packed_bundle_is_readable_by_tarfile(tmp_path):
    model = save_model(tmp_path / "model")
    pack(model, tmp_path / "a.isplat")
    with tarfile.open(tmp_path / "a.isplat", "r:") as archive:
        assert [(each.name, each.mode, each.mtime) for each in archive] == [(MANIFEST, 0o644, 0), (TENSORS, 0o644, 0)]
        assert archive.extractfile(TENSORS).read() == (model / TENSORS).read_bytes()


@pytest.mark.parametrize("style", [tarfile.USTAR_FORMAT, tarfile.GNU_FORMAT])
def test_unpack_accepts_archive_written_by_tarfile(tmp_path, style):
    model = save_model(tmp_path / "model")
    with tarfile.open(tmp_path / "a.isplat", "w", format=style) as archive:
        for name in (MANIFEST, TENSORS):
            archive.add(model / name, name)
    assert unpacked(tmp_path / "a.isplat", tmp_path / "b") == contents(model)


@pytest.mark.skipif(shutil.which("tar") is None, reason="there is no tar")
@pytest.mark.parametrize("style", ["ustar", "gnu"])
def test_unpack_accepts_archive_written_by_tar(tmp_path, style):
    model = save_model(tmp_path / "model")
    subprocess.run(["tar", f"--format={style}", "-cf", tmp_path / "a.isplat", MANIFEST, TENSORS], cwd=model, check=True)
    assert unpacked(tmp_path / "a.isplat", tmp_path / "b") == contents(model)


@pytest.mark.parametrize("sizes", [(0, 0), (1, 511), (512, 512), (513, 1)])
def test_pack_and_unpack_round_trip_for_sizes_around_block_size(tmp_path, sizes):
    model = tmp_path / "model"
    model.mkdir()
    for name, size in zip((MANIFEST, TENSORS), sizes, strict=True):
        (model / name).write_bytes(b"x" * size)
    pack(model, tmp_path / "a.isplat")
    assert unpacked(tmp_path / "a.isplat", tmp_path / "b") == contents(model)


def test_pack_replaces_existing_file_only_with_overwrite(tmp_path):
    model = save_model(tmp_path / "model")
    (tmp_path / "a.isplat").write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        pack(model, tmp_path / "a.isplat")
    assert (tmp_path / "a.isplat").read_bytes() == b"mine"
    pack(model, tmp_path / "a.isplat", overwrite=True)
    assert unpacked(tmp_path / "a.isplat", tmp_path / "b") == contents(model)


def test_members_of_rejects_truncated_archive(tmp_path):
    model = save_model(tmp_path / "model")
    pack(model, tmp_path / "a.isplat")
    payload = (tmp_path / "a.isplat").read_bytes()
    for size in {0, 1, 511, 512, 513, 1024, *range(0, len(payload), 101), len(payload) - 1}:
        with pytest.raises(Rejected):
            members_of(io.BytesIO(payload[:size]), size)
