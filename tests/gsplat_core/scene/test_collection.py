"""Editing of Gaussians: selections, changes, and their effect on pictures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core import Camera, Gaussians, InvalidInput, reference, render, save_gaussians, save_ply
from gsplat_core.errors import BundleError, ExportError, InvalidSetting
from gsplat_core.io.model_sources import load_model
from gsplat_core.scene.collection import GaussianCollection, harmonic_bases, rotated_harmonics


def gaussians(count=40, degree=3, seed=0, **extra):
    g = torch.Generator().manual_seed(seed)
    normal = lambda *shape: torch.randn(*shape, generator=g)
    return Gaussians(
        means=normal(count, 3), quats=normal(count, 4), log_scales=normal(count, 3) * 0.3 - 1.5,
        logit_opacities=normal(count), sh=normal(count, (degree + 1) ** 2, 3) * 0.3, extra=extra,
    )  # fmt: skip


def rotation(seed=0):
    g = torch.Generator().manual_seed(seed)
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64))
    return matrix * torch.linalg.det(matrix)


def pose(matrix, shift):
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = matrix, shift
    return viewmat


def test_harmonic_bases_equal_renderer():
    g = torch.Generator().manual_seed(0)
    dirs = torch.nn.functional.normalize(torch.randn(9, 3, generator=g, dtype=torch.float64), dim=-1)
    bases = harmonic_bases(4, dirs)
    for k in range(25):
        coefficients = torch.zeros(9, 25, 3, dtype=torch.float64)
        coefficients[:, k] = 1
        wanted = reference.spherical_harmonics(4, dirs, coefficients)[:, 0]
        torch.testing.assert_close(bases[:, k], wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degree", range(5))
def test_rotated_harmonics_equal_values_at_inverse_rotated_directions(degree):
    g = torch.Generator().manual_seed(1)
    sh = torch.randn(6, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64)
    dirs = torch.nn.functional.normalize(torch.randn(6, 3, generator=g, dtype=torch.float64), dim=-1)
    matrix = rotation(2)
    after = reference.spherical_harmonics(degree, dirs, rotated_harmonics(sh, matrix))
    torch.testing.assert_close(after, reference.spherical_harmonics(degree, dirs @ matrix, sh), rtol=0, atol=1e-10)


@pytest.mark.parametrize("degree", [0, 3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_rotated_collection_equals_view_of_rotated_camera(degree, seed):
    scene, matrix, shift = gaussians(degree=degree), rotation(seed), np.array([0.3, -0.2, 6.0])
    camera = Camera.from_focal(60.0, 64, 48).with_pose(pose(np.eye(3), shift))
    opposite = camera.with_pose(pose(matrix.numpy(), shift))
    edited = GaussianCollection(scene)
    edited.transform(rotation=matrix)
    for mine, wanted in zip(render(edited.gaussians, camera), render(scene, opposite), strict=True):
        torch.testing.assert_close(mine, wanted, rtol=1e-3, atol=1e-3)


def test_scaled_collection_equal_from_proportional_distance():
    scene, edited = gaussians(), GaussianCollection(gaussians())
    camera = Camera.from_focal(60.0, 64, 48).with_pose(pose(np.eye(3), [0, 0, 6.0]))
    edited.transform(scale=2.0, translation=(1.0, 0.0, 0.0))
    farther = camera.with_pose(pose(np.eye(3), [-1.0, 0, 12.0]))
    torch.testing.assert_close(render(edited.gaussians, farther).image, render(scene, camera).image, rtol=0, atol=1e-4)


def test_collection_selections_combine():
    scene = GaussianCollection(gaussians(semantics=torch.eye(4).repeat(10, 1)))
    means = scene.gaussians.means
    box = scene.in_box((-1, -1, -1), (1, 1, 0))
    assert torch.equal(box, (means.abs() <= 1).all(-1) & (means[:, 2] <= 0)) and box.any()
    sphere = scene.in_sphere((0, 0, 0.5), 1.0)
    assert torch.equal(sphere, (means - torch.tensor([0, 0, 0.5])).norm(dim=-1) <= 1) and sphere.any()
    labels = scene.labelled(2)
    assert labels.nonzero()[:, 0].tolist() == list(range(2, 40, 4))
    kept = (box | sphere) & ~labels
    scene.delete(~kept)
    assert torch.equal(scene.gaussians.means, means[kept]) and len(scene) == kept.sum()


def test_collection_edits_change_selected_gaussians_only():
    before = replace(gaussians(), right_sh=torch.ones(40, 16, 3))
    scene = GaussianCollection(before)
    chosen = scene.in_sphere((0, 0, 0), 1.2)
    scene.transform(chosen, rotation=rotation(), translation=(0, 0, 9))
    scene.recolour(chosen, colour=(1.0, 0.5, 0.0))
    after = scene.gaussians
    for name, tensor in after.tensors().items():
        changed = (tensor != before.tensors()[name]).reshape(40, -1).any(-1)
        wanted = torch.zeros_like(chosen) if name in ("logit_opacities", "log_scales") else chosen
        assert torch.equal(changed, wanted), name
    assert (after.right_sh[chosen] == 0).all()
    colours = reference.spherical_harmonics(3, after.means + 5, after.sh) + 0.5
    torch.testing.assert_close(colours[chosen], torch.tensor([1.0, 0.5, 0.0]).expand(int(chosen.sum()), 3))


def test_collection_merge_keeps_optional_tensors_of_both():
    scene = GaussianCollection(gaussians(4, degree=1, first=torch.ones(4, 2)))
    other = replace(gaussians(3, degree=2, seed=1, second=torch.ones(3)), right_sh=torch.ones(3, 9, 3))
    scene.merge(GaussianCollection(other))
    merged = scene.gaussians
    assert len(scene) == 7 and merged.sh_degree == 2 and set(merged.extra) == {"first", "second"}
    assert torch.equal(merged.sh[4:], other.sh) and (merged.sh[:4, 4:] == 0).all()
    assert (merged.extra["first"][4:] == 0).all() and merged.right_sh[4:].all() and not merged.right_sh[:4].any()


def test_collection_rejects_invalid_edits():
    scene = GaussianCollection(gaussians())
    for edit, message in [
        (lambda: scene.in_box((1, 0, 0), (0, 1, 1)), "is empty; give the smaller corner first"),
        (lambda: scene.in_box((1, 0), (0, 1)), r"low must be three finite numbers, got \[1.0, 0.0\]"),
        (lambda: scene.in_sphere((0, 0, 0), -1.0), "radius must be 0 or more, got -1.0"),
        (lambda: scene.in_sphere((0, 0, math.nan), 1.0), "center must be three finite numbers"),
        (lambda: scene.labelled(0), "have no labels .*--losses semantics"),
        (lambda: scene.transform(rotation=2 * torch.eye(3)), "without scale and reflection"),
        (lambda: scene.transform(rotation=-torch.eye(3)), "without scale and reflection"),
        (lambda: scene.transform(scale=0.0), "scale must be from 1e-37 to 1e[+]37, got 0.0"),
        (lambda: scene.transform(scale=1e300), "got 1e[+]300"),
        (lambda: scene.recolour(colour=(2, 0, 0)), "from 0 to 1, got"),
        (lambda: scene.delete(torch.ones(3, dtype=torch.bool)), r"bool \[40\], got torch.bool \[3\]"),
        (lambda: scene.merge("tool.ply"), "merge takes Gaussians, got str"),
        (lambda: GaussianCollection(scene), "takes Gaussians, got GaussianCollection; .* as gaussians"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            edit()
    labelled = GaussianCollection(gaussians(semantics=torch.zeros(40, 4)))
    with pytest.raises(InvalidInput, match=r"cannot append extra 'semantics' \[3, 5\] to \[40, 4\]"):
        labelled.merge(gaussians(3, semantics=torch.zeros(3, 5)))
    with pytest.raises(InvalidInput, match="label must be from 0 to 3, got 4"):
        GaussianCollection(gaussians(semantics=torch.zeros(40, 4))).labelled(4)


@pytest.mark.parametrize("name", ["cut.ply", "cut.splat", "cut.spz", "cut"])
def test_edited_collection_save_and_load(tmp_path, name):
    scene = GaussianCollection(gaussians(degree=1))
    scene.delete(scene.in_sphere((0, 0, 0), 1.0))
    save_gaussians(scene.gaussians, tmp_path / name)
    loaded = load_model(tmp_path / name).gaussians
    assert loaded.count == len(scene)
    order = lambda means: means[means[:, 0].argsort()]
    torch.testing.assert_close(order(loaded.means), order(scene.gaussians.means), rtol=0, atol=1e-3)
    with pytest.raises((OSError, BundleError)):
        save_gaussians(scene.gaussians, tmp_path / name)
    save_gaussians(scene.gaussians, tmp_path / name, overwrite=True)


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a"])
def test_save_gaussians_rejects_non_finite_positions(tmp_path, name):
    scene = gaussians()
    scene.means[3, 1] = math.nan
    with pytest.raises(ExportError, match="means holds 1 values that are NaN or infinite"):
        save_gaussians(scene, tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_gaussian_functions_name_wrong_argument_type(tmp_path):
    scene = GaussianCollection(gaussians())
    camera = Camera.from_focal(40, 16, 16)
    for name, call in {
        "save_gaussians": lambda: save_gaussians(scene, tmp_path / "a.ply"),
        "save_ply": lambda: save_ply(scene, tmp_path / "a.ply"),
        "render": lambda: render(scene, camera),
    }.items():
        with pytest.raises(InvalidInput, match=f"{name} takes Gaussians, got GaussianCollection"):
            call()


def test_render_names_non_tensor_background():
    with pytest.raises(InvalidInput, match=r"background must be a tensor \[3\], got list"):
        render(gaussians(), Camera.from_focal(40, 16, 16), background=[1, 1, 1])


def test_save_gaussians_rejects_unknown_file_format(tmp_path):
    for name in ("cut.zip", "cut.txt"):
        with pytest.raises(InvalidSetting):
            save_gaussians(gaussians(), tmp_path / name)
