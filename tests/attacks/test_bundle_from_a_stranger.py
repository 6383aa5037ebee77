"""A model bundle may come from anyone: each of these is refused with its reason, and nothing large is allocated."""

import hashlib
import json
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import save

from gsplat_core.deformation import new_field
from gsplat_core.errors import BundleCorrupt, BundleError, UnknownFormatVersion
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.model import Model


@pytest.fixture
def folder(tmp_path):
    random = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    gaussians = Gaussians(draw(5, 3), draw(5, 4), draw(5, 3), draw(5), draw(5, 1, 3))
    field = new_field("basis", gaussians, (0.0, 1.0), bumps=6).detached_copy()
    save_bundle(Model(1, gaussians, field, Camera.from_focal(50.0, 8, 8), (0.0, 1.0)), tmp_path)
    return tmp_path


def edit_manifest(folder, change):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def replace_tensors(folder, payload):
    """Other tensors with a digest that fits: an attacker can compute one too."""
    (folder / "model.safetensors").write_bytes(payload)
    tensors = {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}
    edit_manifest(folder, lambda manifest: manifest.update(tensors=tensors))


def tensors_of(folder):
    return dict(load_bundle(folder).tensors())


def test_a_changed_byte_is_noticed(folder):
    path = folder / "model.safetensors"
    payload = bytearray(path.read_bytes())
    payload[-5] ^= 1
    path.write_bytes(payload)
    with pytest.raises(BundleCorrupt, match="SHA-256"):
        load_bundle(folder)


@pytest.mark.parametrize("keep", [0, 4, 8, 100, -1])
def test_a_truncated_file_is_noticed(folder, keep):
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(BundleCorrupt, match=r"bytes"):
        load_bundle(folder)


@pytest.mark.parametrize("version", [0, 2, 99])
def test_another_format_version_names_both(folder, version):
    edit_manifest(folder, lambda manifest: manifest.update(format_version=version))
    with pytest.raises(UnknownFormatVersion, match=rf"{version}.*reads 1"):
        load_bundle(folder)


@pytest.mark.parametrize("missing", ["manifest.json", "model.safetensors"])
def test_a_missing_file_is_named(folder, missing):
    (folder / missing).unlink()
    with pytest.raises(BundleError, match=missing):
        load_bundle(folder)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(BundleError, match="nowhere"):
        load_bundle(tmp_path / "nowhere")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_are_not_finite_are_counted_and_named(folder, value):
    tensors = tensors_of(folder)
    tensors["field.weights"] = tensors["field.weights"].clone()
    tensors["field.weights"][1, 2, :3] = value
    replace_tensors(folder, save(tensors))
    with pytest.raises(BundleCorrupt, match=r"field\.weights holds 3 of 390"):
        load_bundle(folder)


def test_tensors_that_the_manifest_does_not_know_are_refused(folder):
    tensors = tensors_of(folder)
    replace_tensors(folder, save(tensors | {"field.extra": torch.zeros(1)}))
    with pytest.raises(BundleCorrupt, match=r"unknown field\.extra"):
        load_bundle(folder)


def test_a_missing_tensor_is_named(folder):
    tensors = tensors_of(folder)
    renamed = {("x" if name == "gaussians.quats" else name): tensor for name, tensor in tensors.items()}
    replace_tensors(folder, save(renamed))
    with pytest.raises(BundleCorrupt, match=r"missing gaussians\.quats, unknown x"):
        load_bundle(folder)


@pytest.mark.parametrize("change", [lambda t: t.T.contiguous(), lambda t: t.view(torch.int32)])
def test_other_shapes_and_types_are_refused(folder, change):
    tensors = tensors_of(folder)
    tensors["gaussians.means"] = change(tensors["gaussians.means"])
    replace_tensors(folder, save(tensors))
    with pytest.raises(BundleCorrupt, match=r"gaussians\.means must be float32 \[5, 3\]"):
        load_bundle(folder)


@pytest.mark.parametrize("length", [26_000_000, 2**40, 2**64 - 1])
def test_a_header_larger_than_allowed_is_refused(folder, length):
    payload = (folder / "model.safetensors").read_bytes()
    replace_tensors(folder, struct.pack("<Q", length) + payload[8:])
    with pytest.raises(BundleCorrupt, match="header"):
        load_bundle(folder)


def test_offsets_outside_the_file_are_refused(folder):
    payload = (folder / "model.safetensors").read_bytes()
    (size,) = struct.unpack("<Q", payload[:8])
    header = json.loads(payload[8 : 8 + size])
    header["gaussians.means"]["data_offsets"] = [2**33, 2**33 + 60]
    text = json.dumps(header).encode().ljust(size)
    replace_tensors(folder, struct.pack("<Q", len(text)) + text + payload[8 + size :])
    with pytest.raises(BundleCorrupt, match="safetensors"):
        load_bundle(folder)


def test_counts_beyond_the_file_take_no_memory(folder):
    """Fifty million Gaussians of 6 bumps would be 20 GB; the file's size tells that they are not there."""
    edit_manifest(folder, lambda manifest: manifest["gaussians"].update(count=50_000_000))
    with pytest.raises(BundleCorrupt, match="describes"):
        load_bundle(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gaussians", {"count": 10**12, "sh_degree": 0}),
        ("gaussians", {"count": -1, "sh_degree": 0}),
        ("gaussians", {"count": 5.5, "sh_degree": 0}),
        ("gaussians", {"count": True, "sh_degree": 0}),
        ("gaussians", {"count": 5, "sh_degree": 9}),
        ("gaussians", None),
        ("time_window_s", [1.0, 0.0]),
        ("time_window_s", [0.0]),
        ("time_window_s", "now"),
        ("version", 0),
        ("training_digest", "../../etc/passwd"),
        ("camera", {}),
        ("camera", {"K": [[0] * 3] * 3, "width_px": 8, "height_px": 8, "world_to_camera": [[0] * 4] * 4}),
        ("field", {"kind": "__import__('os').system('true')"}),
        ("field", {"kind": "basis", "bumps": 2**40, "channels": 13, "time_window_s": [0, 1]}),
        (
            "field",
            {"kind": "basis", "bumps": 6, "channels": 14, "time_window_s": [0, 1], "origin_s": 0, "spacing_s": 1},
        ),
        (
            "field",
            {"kind": "basis", "bumps": 6, "channels": 13, "time_window_s": [0, 1], "origin_s": 0, "spacing_s": 0},
        ),
        ("tensors", {"bytes": 10, "sha256": "zz"}),
    ],
)
def test_manifest_values_out_of_range_are_refused(folder, key, value):
    edit_manifest(folder, lambda manifest: manifest.update({key: value}))
    with pytest.raises(BundleCorrupt):
        load_bundle(folder)


def test_a_huge_grid_takes_no_memory(folder):
    grid = {
        "kind": "hexplane", "time_window_s": [0, 1], "channels": 65536, "width": 65536, "depth": 60,
        "resolution": [65536] * 4, "levels": [1],
    }  # fmt: skip
    edit_manifest(folder, lambda manifest: manifest.update(field=grid))
    with pytest.raises(BundleCorrupt, match="describes"):
        load_bundle(folder)


@pytest.mark.parametrize(
    "text",
    [b"", b"\xff\xfe", b"[1, 2]", b"{" * 100_000, b'{"format_version": NaN}', b"1" * 5000, b" " * (1 << 20) + b"{}"],
)
def test_a_manifest_that_is_none_is_refused(folder, text):
    (folder / "manifest.json").write_bytes(text)
    with pytest.raises(BundleCorrupt, match=r"manifest\.json"):
        load_bundle(folder)


def test_a_pickle_in_place_of_the_tensors_is_not_opened(folder, tmp_path):
    import pickle

    marker = tmp_path / "executed"

    class Attack:
        def __reduce__(self):
            return marker.touch, ()

    payload = pickle.dumps([Attack(), np.zeros(600)])
    replace_tensors(folder, payload)
    with pytest.raises(BundleCorrupt):
        load_bundle(folder)
    assert not marker.exists()


def test_a_box_inside_out_is_refused(tmp_path):
    gaussians = Gaussians(torch.rand(2, 3), torch.rand(2, 4), torch.rand(2, 3), torch.rand(2), torch.rand(2, 1, 3))
    field = new_field("hexplane", gaussians, (0.0, 1.0), channels=2, resolution=(3, 3, 3, 3)).detached_copy()
    field.box = field.box.flip(0)
    save_bundle(Model(1, gaussians, field, Camera.from_focal(50.0, 8, 8), (0.0, 1.0)), tmp_path)
    with pytest.raises(BundleCorrupt, match="box"):
        load_bundle(tmp_path)
