"""Manifest values out of their range are refused in one sentence that names the value."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from gsplat_core.deformation import kind_of
from gsplat_core.errors import BundleCorrupt, BundleError
from gsplat_core.io.bundle import (
    COUNT,
    FOCAL_PX,
    INTRINSICS_PX,
    LONGEST_FIELD_WINDOW_S,
    LONGEST_WINDOW_S,
    MAX_MANIFEST_BYTES,
    MOST_PIXELS,
    POSE,
    SH_DEGREE,
    SIDE_PX,
    VERSION,
    load_bundle,
    save_bundle,
)  # fmt: skip
from gsplat_core.models import Model
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.value_ranges import MAX_NESTING

NO_INTEGERS = (None, True, 1.5, "5", [], {}, -1, 10**400, 2**63, float(2**20))
NO_NUMBERS = (None, False, "1", [], {}, 10**400, -(10**400), 1e300)
IDENTITY = np.eye(4).tolist()


def pose(rotation: object, translation: tuple[float, float, float] = (0, 0, 0)) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix.tolist()


def refused(bundle, name: str) -> str:
    with pytest.raises(BundleCorrupt) as caught:
        load_bundle(bundle.folder)
    message = str(caught.value)
    assert name in message and "\n" not in message and len(message) < 400
    return message


@pytest.mark.parametrize(
    "path",
    [
        "version", "gaussians.count", "gaussians.sh_degree", "camera.width_px", "camera.height_px", "tensors.bytes",
        "parameters", "field.bumps", "field.channels",
    ],
)  # fmt: skip
@pytest.mark.parametrize("value", NO_INTEGERS, ids=lambda value: f"{value!r:.12}")
def test_manifest_integers_out_of_range_are_refused(bundle, path, value):
    bundle.set(path, value)
    refused(bundle, path.split(".")[-1])


@pytest.mark.parametrize("path", ["field.origin_s", "field.spacing_s"])
@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: f"{value!r:.12}")
def test_manifest_numbers_of_other_type_or_range_are_refused(bundle, path, value):
    bundle.set(path, value)
    refused(bundle, path.split(".")[-1])


@pytest.mark.parametrize("path", ["time_window_s", "field.time_window_s"])
@pytest.mark.parametrize(
    "window",
    [[0, 1e9], [-1e9, 0], [0, 400_000], [1, 0], [0], [0, 1, 2], [0, "1"], [0, 10**400], [0, True], None, 5, {"0": 1}, [[0], [1]]],
    ids=lambda value: f"{value!r:.16}",
)  # fmt: skip
def test_manifest_with_invalid_time_window_is_refused(bundle, path, window):
    bundle.set(path, window)
    refused(bundle, "time_window_s")


def test_manifest_time_window_is_limited_to_one_day(bundle):
    bundle.set("time_window_s", [1e9, 1e9 + 86_400])
    assert load_bundle(bundle.folder).time_window_s == (1e9, 1e9 + 86_400)
    bundle.set("time_window_s", [1e9, 1e9 + 86_401])
    refused(bundle, "at most 86400 s apart")


@pytest.mark.parametrize(
    ("width", "height"), [(16_385, 1), (1, 16_385), (65_536, 65_536), (0, 8), (8, 0), (16_384, 16_384), (8192, 8193)]
)
def test_manifest_with_invalid_image_size_is_refused(bundle, width, height):
    bundle.edit(lambda values: values["camera"].update(width_px=width, height_px=height))
    refused(bundle, "camera")


def test_manifest_with_largest_image_size_is_accepted(bundle):
    bundle.edit(lambda values: values["camera"].update(width_px=16_384, height_px=4096))
    assert load_bundle(bundle.folder).camera.width_px == 16_384


@pytest.mark.parametrize(
    "K",
    [
        [[0, 0, 4], [0, 50, 4], [0, 0, 1]],
        [[-50, 0, 4], [0, 50, 4], [0, 0, 1]],
        [[50, 0, 4], [0, 1e-9, 4], [0, 0, 1]],
        [[1e12, 0, 4], [0, 50, 4], [0, 0, 1]],
        [[50, 0, 1e300], [0, 50, 4], [0, 0, 1]],
        [[50, 1, 4], [0, 50, 4], [0, 0, 1]],
        [[50, 0, 4], [0, 50, 4], [0, 0, 2]],
        [[50, 0, 4], [0, 50, 4]],
        [[50, 0], [0, 50], [0, 0]],
        [[50, 0, 4], [0, 50, 4], [0, 0, 10**400]],
        [[50, 0, 4], [0, 50, 4], "001"],
        {"fx": 50},
        None,
    ],
    ids=lambda value: f"{value!r:.24}",
)
def test_manifest_with_invalid_intrinsics_is_refused(bundle, K):
    bundle.set("camera.K", K)
    refused(bundle, "K")


@pytest.mark.parametrize(
    "matrix",
    [
        pose(np.zeros((3, 3))),
        pose(np.diag([1, 1, -1])),
        pose(np.diag([1, 1, 1.01])),
        pose(np.ones((3, 3))),
        pose(np.diag([1e300, 1, 1])),
        pose([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]),
        pose(np.eye(3), (1e12, 0, 0)),
        [*IDENTITY[:3], [0, 0, 1, 1]],
        [*IDENTITY[:3], [0, 0, 0, 0]],
        [row[:3] for row in IDENTITY],
        [*IDENTITY[:3], [0, 0, 0, True]],
        [*IDENTITY[:3], None],
        "identity",
    ],
    ids=lambda value: f"{value!r:.24}",
)
def test_manifest_with_invalid_pose_is_refused(bundle, matrix):
    bundle.set("camera.world_to_camera", matrix)
    refused(bundle, "camera: ")


def test_manifest_with_rounded_rotation_is_accepted(bundle):
    angle = 0.3
    rotation = [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
    rounded = np.round(rotation, 4)
    bundle.set("camera.world_to_camera", pose(rounded, (1e3, 2, 3)))
    assert load_bundle(bundle.folder).camera.world_to_camera[0, 3] == 1e3


@pytest.mark.parametrize("value", [None, "", "fisheye2", 3, ["pinhole"], "pinhole" * 10_000])
def test_manifest_with_unknown_camera_model_is_refused(bundle, value):
    bundle.set("camera.model", value)
    refused(bundle, "model")


@pytest.mark.parametrize(
    ("path", "value"),
    [("units.length", "m"), ("units.length", None), ("units.time", "ms"), ("units", []), ("units", None)],
)
def test_manifest_with_other_units_is_refused(bundle, path, value):
    bundle.set(path, value)
    refused(bundle, path.split(".")[-1])


def test_manifest_with_wrong_parameter_count_is_refused(bundle):
    bundle.edit(lambda values: values.update(parameters=values["parameters"] + 1))
    refused(bundle, "parameters")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("channels", 4097),
        ("channels", 0),
        ("width", 1 << 20),
        ("depth", 65),
        ("resolution", [3, 3, 3]),
        ("resolution", [3, 3, 3, 1]),
        ("resolution", [1 << 13, 3, 3, 3]),
        ("resolution", [3, 3, 3, 10**400]),
        ("resolution", 3),
        ("levels", []),
        ("levels", [0]),
        ("levels", [1] * 17),
        ("levels", [65]),
    ],
)
def test_manifest_with_invalid_hexplane_sizes_is_refused(hexplane_bundle, name, value):
    hexplane_bundle.set(f"field.{name}", value)
    refused(hexplane_bundle, name)


@pytest.mark.parametrize(
    "sizes",
    [
        {"channels": 4096, "resolution": [4096] * 4, "levels": [64] * 16},
        {"width": 4096, "depth": 64},
        {"channels": 3},
    ],
)
def test_hexplane_sizes_beyond_file_size_are_refused(hexplane_bundle, sizes):
    """The largest sizes within the ranges would need about 10^17 bytes."""
    hexplane_bundle.edit(lambda values: (values["field"].update(sizes), values.pop("parameters")))
    refused(hexplane_bundle, "describes")


@pytest.mark.parametrize("kind", [None, "", "auto", "__import__('os').system('true')", 7, ["basis"], "x" * 100_000])
def test_manifest_with_unknown_field_kind_is_refused(bundle, kind):
    bundle.set("field.kind", kind)
    assert "known are basis, hexplane" in refused(bundle, "field")


@pytest.mark.parametrize("value", [[], "basis", 5, True])
def test_manifest_field_that_is_no_object_is_refused(bundle, value):
    bundle.set("field", value)
    refused(bundle, "field must be a JSON object")


def test_manifest_with_duplicate_key_is_refused(bundle):
    text = bundle.manifest.read_text()
    bundle.manifest.write_text(text.replace('"version": 1', '"version": 1, "version": 2'))
    refused(bundle, "'version' occurs twice")


@pytest.mark.parametrize("depth", [17, 900, 200_000])
@pytest.mark.parametrize(("start", "end"), [("[", "]"), ('{"a":', "}")])
def test_deeply_nested_manifest_is_refused(bundle, depth, start, end):
    nested = start * depth + "1" + end * depth
    bundle.manifest.write_text('{"format_version": 1, "more": ' + nested + "}")
    with pytest.raises(BundleCorrupt, match=r"manifest\.json"):
        load_bundle(bundle.folder)


@pytest.mark.parametrize("text", ["1e400", "-1e400", "NaN", "Infinity", "1" + "0" * 5000, "0x10", "1_000", "٣"])
def test_manifest_with_invalid_json_numbers_is_refused(bundle, text):
    values = bundle.manifest.read_text()
    bundle.manifest.write_text(values.replace('"spacing_s": ', f'"spacing_s": {text}, "was": '))
    with pytest.raises(BundleCorrupt, match=r"manifest\.json"):
        load_bundle(bundle.folder)


def test_unknown_manifest_keys_are_ignored(bundle):
    bundle.edit(lambda values: values.update(comment="\ud800", more=[1, {"a": None}]))
    assert load_bundle(bundle.folder).gaussians.count == 5


def test_save_bundle_refuses_values_out_of_range(tmp_path):
    gaussians = Gaussians(*(torch.zeros(2, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    camera = Camera.from_focal(50.0, 8, 8)
    save_bundle(Model(1, gaussians, None, camera, (0.0, 1.0)), tmp_path)
    before = (tmp_path / "manifest.json").read_bytes()
    for model in (
        Model(2, gaussians, None, camera, (0.0, 1e6)),
        Model(2, gaussians, None, camera.with_pose(pose(2 * np.eye(3))), (0.0, 1.0)),
        Model(2, gaussians, None, Camera.from_focal(50.0, 20_000, 8), (0.0, 1.0)),
    ):
        with pytest.raises(BundleError, match="was not saved"):
            save_bundle(model, tmp_path)
    assert (tmp_path / "manifest.json").read_bytes() == before
    assert load_bundle(tmp_path).version == 1


def test_bundle_documentation_states_manifest_ranges():
    text = (Path(__file__).parents[2] / "docs" / "design" / "bundle.md").read_text(encoding="utf-8")
    ranges = (VERSION, COUNT, SH_DEGREE, SIDE_PX, FOCAL_PX, INTRINSICS_PX, POSE)
    for low, high in [(each.low, each.high) for each in ranges]:
        assert f"{low:g} to {high:g}" in text or f"{low} to {high}" in text, (low, high)
    for bound in (MOST_PIXELS, LONGEST_WINDOW_S, LONGEST_FIELD_WINDOW_S, MAX_MANIFEST_BYTES, MAX_NESTING):
        assert f"{bound:.0f}" in text, bound
    for name in ("basis", "hexplane"):
        for value, wanted in kind_of(name).config.items():
            assert f"| `{name}`: `{value}` | {wanted} |" in text, (name, value)
