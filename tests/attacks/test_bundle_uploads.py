"""Uploads that are no archive of a model are refused with one sentence; nothing is kept or executed."""

import io
import os
import pickle
import tarfile
import zipfile
import zlib

import pytest
import torch

from services.errors import Rejected, StoreUnavailable
from services.registry.bundle_file import MANIFEST, TENSORS, pack
from services.registry.models import ModelRegistry

BLOCK = 512


@pytest.fixture
def registry(tmp_path):
    with ModelRegistry(tmp_path / "registry", most_upload_bytes=4 << 20) as opened:
        yield opened


@pytest.fixture
def refused(registry, tmp_path):
    """Return a function that uploads bytes and returns the sentence of the refusal."""

    def upload(payload):
        (tmp_path / "upload").write_bytes(payload)
        with pytest.raises(Rejected) as raised:
            registry.upload("liver", tmp_path / "upload", None, "stranger")
        assert registry.models() == []
        assert [list((tmp_path / "registry" / each).iterdir()) for each in ("incoming", "blobs", "unpacked")] == [
            [],
            [],
            [],
        ]
        sentence = str(raised.value)
        assert "\n" not in sentence and str(tmp_path) not in sentence and len(sentence) < 300
        return sentence

    return upload


@pytest.fixture
def payload(bundle, tmp_path):
    """Return the bytes of a valid upload."""
    pack(bundle.folder, tmp_path / "good")
    return (tmp_path / "good").read_bytes()


def archive(*members, style=tarfile.USTAR_FORMAT):
    """Return a tar archive of members (name, bytes, changes of the header)."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=style) as made:
        for name, content, changes in members:
            info = tarfile.TarInfo(name)
            info.size = len(content)
            for key, value in changes.items():
                setattr(info, key, value)
            made.addfile(info, io.BytesIO(content))
    return file.getvalue()


def with_header(payload, start, offset, value):
    """Return the archive with other bytes in a header and a matching checksum."""
    block = bytearray(payload[start : start + BLOCK])
    block[offset : offset + len(value)] = value
    block[148:156] = b" " * 8
    block[148:156] = f"{sum(block):06o}\0 ".encode()
    return payload[:start] + bytes(block) + payload[start + BLOCK :]


def second_header(payload):
    """Return the offset of the tensor file's header."""
    size = int(payload[124:135], 8)
    return BLOCK + size + -size % BLOCK


class Attack:
    """Object that creates a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return self.marker.touch, ()


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickle_upload_is_refused_without_executing(refused, tmp_path, protocol):
    marker = tmp_path / "executed"
    assert "intrasplat pack" in refused(pickle.dumps([Attack(marker), bytes(5000)], protocol))
    assert not marker.exists()


def test_torch_checkpoint_upload_is_refused_without_executing(refused, tmp_path):
    file = io.BytesIO()
    torch.save({"means": torch.zeros(5, 3), "attack": Attack(tmp_path / "executed")}, file)
    assert "zip archive" in refused(file.getvalue())
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "name",
    [
        "../../manifest.json",
        "/etc/passwd",
        "./manifest.json",
        "x/../manifest.json",
        "manifest.json/",
        "manifest.json\\..",
        "MANIFEST.JSON",
        "",
    ],
)
def test_upload_with_paths_in_member_names_is_refused(refused, name):
    assert "must hold manifest.json and then model.safetensors" in refused(
        archive((name, b"{}", {}), (TENSORS, b"x", {}))
    )
    assert "must hold" in refused(archive((MANIFEST, b"{}", {}), (name.replace("manifest.json", TENSORS), b"x", {})))


def test_upload_with_tar_name_prefix_is_refused(refused, payload):
    assert "must hold" in refused(with_header(payload, 0, 345, b"../../root"))


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE, tarfile.GNUTYPE_SPARSE],
)
def test_upload_with_links_devices_folders_or_sparse_files_is_refused(refused, payload, kind):
    for start in (0, second_header(payload)):
        assert "as plain files" in refused(with_header(payload, start, 156, kind))


def test_upload_with_link_as_manifest_is_refused(refused):
    link = {"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}
    assert "as plain files" in refused(archive((MANIFEST, b"", link), (TENSORS, b"x", {})))


def test_upload_with_extra_repeated_or_swapped_files_is_refused(refused):
    manifest, tensors = (MANIFEST, b"{}", {}), (TENSORS, b"x", {})
    assert "does not end after" in refused(archive(manifest, tensors, ("evil.py", b"x", {})))
    assert "does not end after" in refused(archive(manifest, tensors, tensors))
    assert "must hold" in refused(archive(manifest, manifest, tensors))
    assert "must hold" in refused(archive(tensors, manifest))
    assert refused(archive(manifest)) and refused(archive())


def test_upload_with_pax_or_long_name_headers_is_refused(refused):
    """Such headers override the name or size of the plain header."""
    renamed = {"pax_headers": {"path": "../../evil", "size": "9"}}
    assert "as plain files" in refused(
        archive((MANIFEST, b"{}", renamed), (TENSORS, b"x", {}), style=tarfile.PAX_FORMAT)
    )
    assert "as plain files" in refused(archive((200 * "a", b"{}", {}), (TENSORS, b"x", {}), style=tarfile.GNU_FORMAT))


@pytest.mark.parametrize(
    "size",
    [
        b"77777777777\0",
        b"\x80" + 10 * b"\0" + b"\x05",
        b"\xff" * 12,
        b"-0000000001\0",
        b"0x000000001\0",
        bytes(12),
        b"1 2\0",
    ],
)
def test_upload_with_invalid_tar_sizes_is_refused(refused, payload, size):
    for start in (0, second_header(payload)):
        assert refused(with_header(payload, start, 124, size.ljust(12, b"\0")))


def test_upload_with_oversized_manifest_is_refused(refused):
    sentence = refused(archive((MANIFEST, bytes((1 << 20) + 1), {}), (TENSORS, b"x", {})))
    assert sentence == "manifest.json has 1048577 bytes; at most 1048576 are allowed, so it is not a manifest"


def test_upload_with_wrong_tar_checksum_or_other_format_is_refused(refused, payload):
    assert "no tar header" in refused(payload[:200] + b"x" + payload[201:])
    assert "no tar header" in refused(b"x" * 5000)
    assert "no tar header" in refused(bytes(5000))
    assert "ends where the header of manifest.json should be" in refused(b"")


def test_upload_with_bytes_between_or_after_files_is_refused(refused, payload):
    end = BLOCK + int(payload[124:135], 8)
    assert "hidden behind manifest.json" in refused(payload[:end] + b"#!" + payload[end + 2 :])
    assert "does not end after" in refused(payload[:-1] + b"x")
    assert "does not end after" in refused(payload + payload)
    assert "does not end after" in refused(payload + bytes(30 * BLOCK))


def test_truncated_upload_is_refused(refused, payload):
    for size in (1, 511, 512, 700, len(payload) // 2, len(payload) - 1):
        assert refused(payload[:size])


def test_compressed_bomb_upload_is_refused(refused, payload):
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr(TENSORS, bytes(50 << 20))
    assert "a zip archive" in refused(bomb.getvalue())
    gzip = zlib.compressobj(wbits=31)
    assert "compressed with gzip" in refused(gzip.compress(bytes(50 << 20)) + gzip.flush())


def test_upload_over_size_limit_is_refused(refused):
    assert "more than 4194304 bytes" in refused(bytes((4 << 20) + 1))


def test_upload_of_git_lfs_pointer_is_refused_by_name(refused):
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{64 * '0'}\nsize 12345\n"
    assert "Git LFS pointer" in refused(pointer.encode())


def test_upload_from_pipe_or_folder_raises_without_waiting(registry, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path):
        with pytest.raises(StoreUnavailable, match="not a plain file"):
            registry.upload("liver", path, None, "stranger")
