"""Malformed and hostile model bundles: `load_bundle` refuses each with its reason and without large allocations."""

import json
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import save

from gsplat_core.deformation import new_field
from gsplat_core.errors import BundleCorrupt, BundleError, UnknownFormatVersion
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians


def tensors_of(bundle):
    return dict(load_bundle(bundle.folder).tensors())


def test_load_bundle_detects_changed_byte(bundle):
    path = bundle.tensors
    payload = bytearray(path.read_bytes())
    payload[-5] ^= 1
    path.write_bytes(payload)
    with pytest.raises(BundleCorrupt, match="SHA-256"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("keep", [0, 4, 8, 100, -1])
def test_load_bundle_detects_truncated_tensors(bundle, keep):
    path = bundle.tensors
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(BundleCorrupt, match=r"bytes"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("version", [0, 2, 99])
def test_load_bundle_names_unknown_and_supported_format_version(bundle, version):
    bundle.edit(lambda manifest: manifest.update(format_version=version))
    with pytest.raises(UnknownFormatVersion, match=rf"{version}.*reads 1"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("missing", ["manifest.json", "model.safetensors"])
def test_load_bundle_names_missing_file(bundle, missing):
    (bundle.folder / missing).unlink()
    with pytest.raises(BundleError, match=missing):
        load_bundle(bundle.folder)


def test_load_bundle_names_missing_folder(tmp_path):
    with pytest.raises(BundleError, match="nowhere"):
        load_bundle(tmp_path / "nowhere")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_load_bundle_counts_non_finite_values_by_tensor(bundle, value):
    tensors = tensors_of(bundle)
    tensors["field.weights"] = tensors["field.weights"].clone()
    tensors["field.weights"][1, 2, :3] = value
    bundle.replace_tensors(save(tensors))
    with pytest.raises(BundleCorrupt, match=r"field\.weights holds 3 of 390"):
        load_bundle(bundle.folder)


def test_load_bundle_refuses_unknown_tensors(bundle):
    tensors = tensors_of(bundle)
    bundle.replace_tensors(save(tensors | {"field.extra": torch.zeros(0)}))
    with pytest.raises(BundleCorrupt, match=r"unknown field\.extra"):
        load_bundle(bundle.folder)


def test_load_bundle_names_missing_tensor(bundle):
    tensors = tensors_of(bundle)
    renamed = {("x" if name == "gaussians.quats" else name): tensor for name, tensor in tensors.items()}
    bundle.replace_tensors(save(renamed))
    with pytest.raises(BundleCorrupt, match=r"missing gaussians\.quats, unknown x"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("change", [lambda t: t.T.contiguous(), lambda t: t.view(torch.int32)])
def test_load_bundle_refuses_wrong_shape_or_dtype(bundle, change):
    tensors = tensors_of(bundle)
    tensors["gaussians.means"] = change(tensors["gaussians.means"])
    bundle.replace_tensors(save(tensors))
    with pytest.raises(BundleCorrupt, match=r"gaussians\.means must be float32 \[5, 3\]"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("length", [26_000_000, 2**40, 2**64 - 1])
def test_load_bundle_refuses_oversized_tensor_header(bundle, length):
    payload = bundle.tensors.read_bytes()
    bundle.replace_tensors(struct.pack("<Q", length) + payload[8:])
    with pytest.raises(BundleCorrupt, match="header"):
        load_bundle(bundle.folder)


def test_load_bundle_refuses_offsets_outside_file(bundle):
    text, _ = bundle.header_and_data()
    header = json.loads(text)
    header["gaussians.means"]["data_offsets"] = [2**33, 2**33 + 60]
    bundle.replace_header(json.dumps(header).encode())
    with pytest.raises(BundleCorrupt, match="safetensors"):
        load_bundle(bundle.folder)


def test_load_bundle_refuses_gaussian_count_beyond_file_size(bundle):
    """Fifty million Gaussians of 6 bumps need 20 GB, which the file does not hold."""
    bundle.edit(lambda manifest: manifest["gaussians"].update(count=50_000_000))
    with pytest.raises(BundleCorrupt, match="describes"):
        load_bundle(bundle.folder)


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
def test_load_bundle_refuses_manifest_values_out_of_range(bundle, key, value):
    bundle.edit(lambda manifest: manifest.update({key: value}))
    with pytest.raises(BundleCorrupt):
        load_bundle(bundle.folder)


@pytest.mark.parametrize(
    "text",
    [b"", b"\xff\xfe", b"[1, 2]", b"{" * 100_000, b'{"format_version": NaN}', b"1" * 5000, b" " * (1 << 20) + b"{}"],
)
def test_load_bundle_refuses_malformed_manifest(bundle, text):
    bundle.manifest.write_bytes(text)
    with pytest.raises(BundleCorrupt, match=r"manifest\.json"):
        load_bundle(bundle.folder)


def test_load_bundle_does_not_unpickle_tensors(bundle, tmp_path):
    import pickle

    marker = tmp_path / "executed"

    class Attack:
        def __reduce__(self):
            return marker.touch, ()

    payload = pickle.dumps([Attack(), np.zeros(600)])
    bundle.replace_tensors(payload)
    with pytest.raises(BundleCorrupt):
        load_bundle(bundle.folder)
    assert not marker.exists()


def test_load_bundle_refuses_inverted_hexplane_box(tmp_path):
    gaussians = Gaussians(torch.rand(2, 3), torch.rand(2, 4), torch.rand(2, 3), torch.rand(2), torch.rand(2, 1, 3))
    field = new_field("hexplane", gaussians, (0.0, 1.0), channels=2, resolution=(3, 3, 3, 3)).detached_copy()
    field.box = field.box.flip(0)
    save_bundle(Model(1, gaussians, field, Camera.from_focal(50.0, 8, 8), (0.0, 1.0)), tmp_path)
    with pytest.raises(BundleCorrupt, match="box"):
        load_bundle(tmp_path)
