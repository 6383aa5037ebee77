"""Compiled unscented projection against plain torch in float64."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core.ops.unscented_projection import (
    CAMERA_COLUMNS,
    UnscentedTransformParameters,
    camera_rows,
    fully_fused_projection_with_ut,
)
from gsplat_core.poses.se3 import RollingShutterType, Shutter, exp
from gsplat_core.scene.distortion import Lens
from tests.gsplat_core.ops.test_unscented_projection import DISTORTED, RADIAL, H, W, scene

CAMERAS = {
    "plain": {},
    "distorted": DISTORTED,
    "fisheye": {"camera_model": "fisheye", "radial_coeffs": RADIAL[:, :4] / 5},
    "plain fisheye": {"camera_model": "fisheye"},
    "ortho": {"camera_model": "ortho"},
}


def project(given, dtype, **options):
    """Return the projection, and the gradients of a weighting of its values."""
    cast = {
        name: value.to(dtype) if isinstance(value, torch.Tensor) else value for name, value in (given | options).items()
    }
    leaves = [cast[name].requires_grad_() for name in ("means", "quats", "scales")]
    out = fully_fused_projection_with_ut(**cast, width=W, height=H, calc_compensations=True)
    total = 0
    for values, size in zip(out[1:], (1, 1, 10, 10), strict=True):
        total = (
            total
            + size
            * (values * torch.cos(torch.arange(values.numel(), device=values.device)).reshape(values.shape)).sum()
        )
    return out, torch.autograd.grad(total, leaves)


def wide_scene(count: int) -> dict[str, torch.Tensor]:
    given = scene(count, 0.03)
    given["means"] = given["means"] * torch.tensor([1.3, 1.3, 1])
    given["means"][::7, 2] *= -1  # behind
    return given


def assert_equal(found, expected):
    found, found_gradients = found
    expected, expected_gradients = expected
    assert torch.equal(found.radii, expected.radii)
    assert (expected.radii > 0).any() and (expected.radii == 0).any()
    for actual, wanted in zip(found[1:], expected[1:], strict=True):
        torch.testing.assert_close(
            actual.detach().double(), wanted.detach(), rtol=2e-3, atol=1e-4 * float(wanted.detach().abs().max())
        )
    for actual, wanted in zip(found_gradients, expected_gradients, strict=True):
        torch.testing.assert_close(actual.double(), wanted, rtol=5e-3, atol=3e-4 * float(wanted.detach().abs().max()))


KINDS = [kind for kind in RollingShutterType if kind is not RollingShutterType.GLOBAL]


@pytest.mark.parametrize(
    ("name", "rolls"),
    [
        *((name, None) for name in CAMERAS),
        *(("distorted", kind) for kind in KINDS),
        ("fisheye", KINDS[0]),
        ("ortho", KINDS[1]),
    ],
)
def test_unscented_projection_values_and_gradients_equal_reference(name, rolls):
    given, options = wide_scene(70), dict(CAMERAS[name])
    if rolls is not None:
        end = exp(torch.tensor([[0.04, 0.02, 0.0, 0.03, -0.05, 0.2]], dtype=torch.float64)) @ given["viewmats"]
        options |= {"rolling_shutter": rolls, "viewmats_rs": end}
    assert_equal(project(given, torch.float32, **options), project(given, torch.float64, **options))


@pytest.mark.parametrize(
    "options", [{"require_all_sigma_points_valid": False}, {"alpha": 0.8, "kappa": 0.5, "in_image_margin_factor": 0.4}]
)
def test_unscented_projection_with_other_sigma_points_batches_and_cameras(options):
    given = wide_scene(40)
    batched = {
        name: torch.stack([given[name], given[name].flip(0)]) for name in ("means", "quats", "scales", "opacities")
    }
    poses = exp(0.05 * torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64))
    batched |= {
        "viewmats": poses,
        "Ks": given["Ks"].expand(2, 3, 3, 3),
        "ut_params": UnscentedTransformParameters(**options),
    }
    radial = RADIAL * torch.arange(6, dtype=torch.float64).view(2, 3, 1) / 5
    assert_equal(*(project(batched, dtype, radial_coeffs=radial) for dtype in (torch.float32, torch.float64)))


def test_unscented_projection_culls_non_finite_values_without_gradient():
    given = wide_scene(16)
    given["means"][0, 1] = math.nan
    given["means"][1, 0] = math.inf
    given["quats"][2] = 0
    given["scales"][3, 2] = math.nan
    given["opacities"][4] = math.nan
    given["means"][5] = 1e30
    given["scales"][6] = 0
    out, gradients = project(given, torch.float32, **DISTORTED)
    assert (out.radii[0, :6] == 0).all()
    for values in (*out[1:], *gradients):
        assert values.isfinite().all()
    for values in gradients:
        assert (values[:6] == 0).all()


@pytest.mark.parametrize(("count", "cameras"), [(0, 1), (3, 0), (0, 0)])
def test_unscented_projection_without_gaussians_or_cameras(count, cameras):
    given = {
        name: value[:count] if name not in ("viewmats", "Ks") else value[:cameras] for name, value in scene(3).items()
    }
    out, gradients = project(given, torch.float32)
    assert out.radii.shape == (cameras, count, 2) and (gradients[0] == 0).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # raised by opcheck itself
def test_unscented_projection_ops_pass_opcheck():
    given = {name: value.float() for name, value in scene(5).items()}
    shutter = Shutter.of(given["viewmats"], None, None)
    rows = camera_rows(shutter, given["Ks"], Lens(radial=RADIAL.float()))[None]
    assert rows.shape == (1, 1, CAMERA_COLUMNS)
    gaussians = [given[name][None].clone().requires_grad_() for name in ("means", "quats", "scales")]
    parameters = UnscentedTransformParameters()
    camera, transform = (
        (0, RollingShutterType.GLOBAL.value, True, W, H, 0.3),
        (parameters.spread, parameters.weight, parameters.center_weight),
    )
    arguments = (
        *gaussians,
        given["opacities"][None],
        rows,
        *camera,
        0.01,
        1e10,
        0.0,
        True,
        0.005,
        *transform,
        0.1,
        True,
    )
    torch.library.opcheck(torch.ops.gsplat_core.project_unscented.default, arguments)
    *values, radii = torch.ops.gsplat_core.project_unscented(*arguments)
    plain = [each.detach() for each in gaussians]
    gradients = [torch.ones_like(each.detach()) for each in values]
    torch.library.opcheck(
        torch.ops.gsplat_core.project_unscented_backward.default,
        (*plain, rows, radii, *gradients, *camera, 0.005, *transform),
    )


def test_unscented_projection_op_rejects_mismatched_sizes():
    given = {name: value.float() for name, value in scene(2).items()}
    rows = torch.zeros(1, 1, CAMERA_COLUMNS - 1)
    with pytest.raises(RuntimeError, match="do not fit together"):
        torch.ops.gsplat_core.project_unscented(
            *(given[name][None] for name in ("means", "quats", "scales")), None, rows, 0, 4, False, W, H, 0.3, 0.01, 1e10,
            0.0, False, 0.0, 0.2, 16.0, -90.0, 0.1, True,
        )  # fmt: skip
