"""Model files replaced by pipes, devices, folders, links or fuzzed bytes."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsplat_core.errors import BundleCorrupt, BundleError, UserError
from gsplat_core.io import model_files
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.ply import load_ply, save_ply
from gsplat_core.scene.gaussians import Gaussians

FILES = ["manifest.json", "model.safetensors"]
FUZZ = settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@contextmanager
def seconds(limit: int) -> Iterator[None]:
    """Fail the test if its body takes longer than the limit."""

    def over(*_: object) -> None:
        raise AssertionError(f"still waiting after {limit} s")

    before = signal.signal(signal.SIGALRM, over)
    signal.alarm(limit)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def listening_socket(path: Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's name is short
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(here)


def dangling_link(path: Path) -> None:
    path.symlink_to("nowhere")


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


def link_to_a_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def link_out(path: Path) -> None:
    outside = path.parent.parent / f"outside-{path.name}"
    outside.write_bytes(b"{}")
    path.symlink_to(outside)


PLACED = [pipe, listening_socket, Path.mkdir, dangling_link, link_to_itself, link_to_a_device, link_out]


@pytest.mark.parametrize("place", PLACED, ids=lambda place: place.__name__)
@pytest.mark.parametrize("name", FILES)
def test_load_bundle_refuses_non_regular_files_without_waiting(bundle, name: str, place: Callable[[Path], object]):
    (bundle.folder / name).unlink()
    place(bundle.folder / name)
    with seconds(10), pytest.raises(BundleError, match=name.split(".")[0]) as refused:
        load_bundle(bundle.folder)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("place", PLACED[:-1], ids=lambda place: place.__name__)
def test_load_ply_refuses_non_regular_files_without_waiting(tmp_path, place):
    place(tmp_path / "a.ply")
    with seconds(10), pytest.raises(BundleError, match=r"a\.ply"):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("next_manifest", [pipe, Path.mkdir, link_out])
def test_load_bundle_refuses_non_regular_next_manifest(bundle, next_manifest):
    bundle.set("tensors.bytes", 1)
    next_manifest(bundle.folder / "manifest.next.json")
    with seconds(10), pytest.raises(BundleError):
        load_bundle(bundle.folder)


def test_load_bundle_follows_links_within_and_to_folder(bundle, tmp_path):
    bundle.tensors.rename(bundle.folder / "tensors.bin")
    bundle.tensors.symlink_to("tensors.bin")
    (tmp_path / "latest").symlink_to(bundle.folder)
    assert load_bundle(tmp_path / "latest").version == 1


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "plain/model"])
def test_load_bundle_raises_for_impossible_folder_name(tmp_path, name):
    (tmp_path / "plain").write_bytes(b"")
    with pytest.raises(BundleError):
        load_bundle(tmp_path / name)


def test_load_bundle_raises_for_file_in_place_of_folder(bundle):
    with pytest.raises(BundleError):
        load_bundle(bundle.tensors)


def test_model_larger_than_memory_is_refused_with_required_size(bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(model_files, "available_bytes", lambda: 100)
    with pytest.raises(BundleError, match=r"needs \d+\.\d GiB of memory to load, and 0\.0 GiB are available"):
        load_bundle(bundle.folder)
    zeros = Gaussians(*(torch.zeros(9, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    save_ply(zeros, tmp_path / "a.ply")
    with pytest.raises(BundleError, match=r"needs \d+\.\d GiB"):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("count", [20_000_000, 50_000_000])
def test_load_bundle_refuses_sparse_tensor_file_larger_than_memory(bundle, monkeypatch, count):
    """A sparse file of matching size costs an attacker no disk space."""
    monkeypatch.setattr(model_files, "available_bytes", lambda: 2**30)
    size = 4 * count * (14 + 6 * 15)
    header = json.dumps({"x": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}}).encode()
    with open(bundle.tensors, "wb") as file:
        file.write(struct.pack("<Q", len(header)) + header)
        file.truncate(8 + len(header) + size)
    bundle.edit(lambda values: (values["gaussians"].update(count=count), values.pop("parameters")))
    bundle.set("tensors.bytes", 8 + len(header) + size)
    with seconds(20), pytest.raises(BundleError, match="of memory to load"):
        load_bundle(bundle.folder)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


def places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of every value in a JSON document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in inner:
        yield (*here, key)
        yield from places(each, (*here, key))


def loaded_or_refused(load: Callable[[], Any]) -> None:
    """Check that loading succeeds or raises a `BundleError` of one sentence."""
    try:
        load()
    except UserError as error:
        assert isinstance(error, BundleError) and len(str(error)) < 1000 and "\n" not in str(error)


@pytest.mark.slow
@FUZZ
@given(data=st.data())
def test_manifest_with_fuzzed_values_loads_or_raises_bundle_error(bundle, data):
    values = bundle.values()
    before = bundle.manifest.read_bytes()
    for place in data.draw(st.lists(st.sampled_from(list(places(values))), min_size=1, max_size=3)):
        target = values
        try:
            for key in place[:-1]:
                target = target[key]
            target[place[-1]] = data.draw(JSON)
        except (KeyError, IndexError, TypeError):
            continue  # an earlier change took the place away
    bundle.manifest.write_text(json.dumps(values))
    try:
        loaded_or_refused(lambda: load_bundle(bundle.folder).render(0.5))
    finally:
        bundle.manifest.write_bytes(before)


@FUZZ
@given(changes=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=6))
def test_manifest_with_fuzzed_bytes_loads_or_raises_bundle_error(bundle, changes):
    before = bundle.manifest.read_bytes()
    text = bytearray(before)
    for at, value in changes:
        text[at % len(text)] = value
    bundle.manifest.write_bytes(bytes(text))
    try:
        loaded_or_refused(lambda: load_bundle(bundle.folder))
    finally:
        bundle.manifest.write_bytes(before)


@pytest.mark.slow
@FUZZ
@given(data=st.data())
def test_fuzzed_tensor_header_loads_or_raises_bundle_error(bundle, data):
    files = bundle.manifest.read_bytes(), bundle.tensors.read_bytes()
    header = bytearray(bundle.header_and_data()[0])
    if data.draw(st.booleans()):
        for _ in range(data.draw(st.integers(1, 4))):
            header[data.draw(st.integers(0, len(header) - 1))] = data.draw(st.integers(0, 255))
    else:
        values = json.loads(header)
        place = data.draw(st.sampled_from(list(places(values))))
        target = values
        for key in place[:-1]:
            target = target[key]
        target[place[-1]] = data.draw(JSON)
        header = bytearray(json.dumps(values).encode())
    bundle.replace_header(bytes(header))
    try:
        loaded_or_refused(lambda: load_bundle(bundle.folder))
    finally:
        bundle.manifest.write_bytes(files[0])
        bundle.tensors.write_bytes(files[1])


@pytest.fixture
def ply(tmp_path) -> bytes:
    random = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    save_ply(Gaussians(draw(3, 3), draw(3, 4), draw(3, 3), draw(3), draw(3, 4, 3)), tmp_path / "whole.ply")
    return (tmp_path / "whole.ply").read_bytes()


@FUZZ
@given(data=st.data())
def test_fuzzed_ply_loads_or_raises_bundle_error(ply, tmp_path, data):
    lines = ply.split(b"\n")
    at = data.draw(st.integers(0, ply[: ply.index(b"end_header")].count(b"\n")))
    words = [
        b"element",
        b"property",
        b"vertex",
        b"face",
        b"list",
        b"double",
        b"uchar",
        b"x",
        b"99999999999",
        b"0",
        b"-1",
        b"\xff",
        b"",
    ]
    lines[at] = b" ".join(data.draw(st.lists(st.sampled_from(words) | st.binary(max_size=6), max_size=4)))
    keep = data.draw(st.integers(0, len(ply)) | st.just(len(ply) * 2))
    (tmp_path / "a.ply").write_bytes(b"\n".join(lines)[:keep])
    loaded_or_refused(lambda: load_ply(tmp_path / "a.ply"))


@pytest.mark.parametrize("value", [1e300, -1e39, float("inf")])
def test_load_ply_refuses_double_beyond_float_range(tmp_path, value):
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1", *(f"property double {n}" for n in names)]
    body = struct.pack("<14d", value, *range(13))
    (tmp_path / "a.ply").write_bytes("\n".join([*header, "end_header", ""]).encode() + body)
    with pytest.raises(BundleCorrupt, match="property x holds 1 of 1 values that are NaN or infinite"):
        load_ply(tmp_path / "a.ply")
