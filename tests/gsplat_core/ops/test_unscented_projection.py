"""The unscented transform projects means as the lens does, covariances as sampling does, and has exact gradients."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.unscented_projection import UnscentedTransformParameters, fully_fused_projection_with_ut
from gsplat_core.poses.se3 import RollingShutterType, Shutter, exp, rotation_vector
from gsplat_core.reference.projection import fully_fused_projection
from gsplat_core.scene.distortion import Lens

W, H = 64, 48
RADIAL = torch.tensor([[-0.25, 0.06, -0.004, 0.01, 0.0, 0.001]], dtype=torch.float64)
TANGENTIAL = torch.tensor([[8e-4, 1e-3]], dtype=torch.float64)
PRISM = torch.tensor([[2e-3, -1e-3, 1.5e-3, 5e-4]], dtype=torch.float64)
DISTORTED = {"radial_coeffs": RADIAL, "tangential_coeffs": TANGENTIAL, "thin_prism_coeffs": PRISM}


def scene(count: int = 12, size: float = 0.02, dtype: torch.dtype = torch.float64) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    flat = (random(count, 2) - 0.5) * torch.tensor([1.1, 0.9])
    depth = 1 + random(count, 1)
    made = {
        "means": torch.cat([flat * depth, depth], -1),
        "quats": random(count, 4) - 0.5,
        "scales": size * (0.3 + random(count, 3)),
        "opacities": 0.3 + 0.6 * random(count),
        "viewmats": exp(torch.tensor([[0.02, -0.01, 0.03, 0.05, -0.04, 0.1]], dtype=torch.float64)),
        "Ks": torch.tensor([[[50.0, 0, 31.0], [0, 52.0, 25.0], [0, 0, 1]]], dtype=torch.float64),
    }
    return {name: value.to(dtype) for name, value in made.items()}


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_unscented_projection_of_small_gaussians_equals_linear(model):
    given = scene(size=1e-3)
    options = {"camera_model": model, "eps2d": 0.0}
    ours = fully_fused_projection_with_ut(**given, width=W, height=H, **options)
    linear = fully_fused_projection(
        given["means"], None, given["quats"], given["scales"], given["viewmats"], given["Ks"], W, H,
        opacities=given["opacities"], **options,
    )  # fmt: skip
    assert torch.equal(ours.radii, linear.radii) and (ours.radii > 0).any()
    for name in ("means2d", "depths", "conics"):
        torch.testing.assert_close(getattr(ours, name), getattr(linear, name), atol=1e-4, rtol=1e-3)


def test_unscented_blur_and_compensation_equal_linear_projection():
    given = scene()
    ours = fully_fused_projection_with_ut(**given, width=W, height=H, calc_compensations=True)
    linear = fully_fused_projection(
        given["means"], None, given["quats"], given["scales"], given["viewmats"], given["Ks"], W, H,
        opacities=given["opacities"], calc_compensations=True,
    )  # fmt: skip
    assert ours.compensations is not None and (ours.compensations > 0.1).any()
    torch.testing.assert_close(ours.compensations, linear.compensations, atol=0.01, rtol=0)
    torch.testing.assert_close(ours.conics, linear.conics, atol=0.01, rtol=0.02)


@pytest.mark.parametrize("coefficients", [DISTORTED, {"camera_model": "fisheye", "radial_coeffs": RADIAL[:, :4] / 5}])
def test_unscented_moments_equal_moments_of_projected_samples(coefficients):
    given = scene(count=2)
    ours = fully_fused_projection_with_ut(**given, width=W, height=H, eps2d=0.0, **coefficients)
    lens = Lens(
        coefficients.get("camera_model", "pinhole"), *(coefficients.get(f"{name}_coeffs") for name in ("radial", "tangential", "thin_prism"))
    )  # fmt: skip
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(8_000, 3, generator=generator, dtype=torch.float64)
    noise = torch.cat([noise, -noise])  # the sampled mean is exact to first order
    from gsplat_core.reference.projection import quat_scale_to_covar_preci

    covars, _ = quat_scale_to_covar_preci(given["quats"], given["scales"])
    for i in range(2):
        world = given["means"][i] + noise @ torch.linalg.cholesky(covars[i]).T
        pixels = lens.project(Shutter.of(given["viewmats"], None, None).to_camera(world[None]), given["Ks"]).points[0]
        torch.testing.assert_close(ours.means2d[0, i], pixels.mean(0), atol=1e-2, rtol=0)
        a, b, c = ours.conics[0, i]
        covariance = torch.linalg.inv(torch.stack([torch.stack([a, b]), torch.stack([b, c])]))
        error = (covariance - torch.cov(pixels.T)).norm() / torch.cov(pixels.T).norm()
        assert error < 0.03


@pytest.mark.slow
def test_unscented_projection_passes_gradcheck_for_all_tensors():
    given = scene(count=3)
    more = {
        **DISTORTED,
        "viewmats_rs": exp(torch.tensor([[0.01, 0.02, -0.01, 0.02, 0.01, -0.03]], dtype=torch.float64))
        @ given["viewmats"],
    }
    names = [name for name in (*given, *more) if name != "opacities"]
    values = [(given | more)[name].clone().requires_grad_() for name in names]

    def project(*tensors):
        found = fully_fused_projection_with_ut(
            **dict(zip(names, tensors, strict=True)), opacities=given["opacities"], width=W, height=H,
            calc_compensations=True, rolling_shutter=RollingShutterType.ROLLING_TOP_TO_BOTTOM,
        )  # fmt: skip
        assert (found.radii > 0).all()
        terms = (found.means2d, found.depths, 10 * found.conics, 10 * found.compensations)
        return sum((each * torch.cos(torch.arange(each.numel()).view(each.shape))).sum() for each in terms)

    torch.autograd.gradcheck(project, values, atol=1e-4, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize("kind", [kind for kind in RollingShutterType if kind.name != "GLOBAL"])
def test_rolling_shutter_projects_point_at_readout_time_of_row(kind):
    given = scene(count=6, size=1e-4)
    end = exp(torch.tensor([[0.04, 0.02, 0.0, 0.02, -0.03, 0.1]], dtype=torch.float64)) @ given["viewmats"]
    ours = fully_fused_projection_with_ut(**given, width=W, height=H, rolling_shutter=kind, viewmats_rs=end)
    for i in range(6):
        u, v = ours.means2d[0, i].tolist()
        along, length = (v, H) if "TOP" in kind.name else (u, W)
        time = (along - 0.5) / (length - 1)
        time = 1 - time if kind.name in ("ROLLING_BOTTOM_TO_TOP", "ROLLING_RIGHT_TO_LEFT") else time
        # Rotation along the shortest arc, translation of the matrices linear in time.
        first, last = given["viewmats"][0], end[0]
        turn = rotation_vector(last[:3, :3] @ first[:3, :3].T)
        pose = exp(torch.cat([torch.zeros(3, dtype=torch.float64), time * turn])) @ first
        pose[:3, 3] = (1 - time) * first[:3, 3] + time * last[:3, 3]
        at = pose[:3, :3] @ given["means"][i] + pose[:3, 3]
        expected = (given["Ks"][0] @ at)[:2] / at[2]
        torch.testing.assert_close(ours.means2d[0, i], expected, atol=1e-4, rtol=0)
    middle = Shutter.of(given["viewmats"], end, kind).matrices()
    torch.testing.assert_close(ours.depths[0], (given["means"] @ middle[0, 2, :3]) + middle[0, 2, 3])


def test_rolling_shutter_with_equal_poses_equals_global_in_float32():
    given = scene(dtype=torch.float32)
    pose = given["viewmats"].clone().requires_grad_()
    still = fully_fused_projection_with_ut(**given, width=W, height=H)
    rolling = fully_fused_projection_with_ut(
        **given | {"viewmats": pose}, width=W, height=H, viewmats_rs=given["viewmats"],
        rolling_shutter=RollingShutterType.ROLLING_LEFT_TO_RIGHT,
    )  # fmt: skip
    torch.testing.assert_close(rolling.means2d, still.means2d, atol=1e-3, rtol=0)
    rolling.means2d.sum().backward()
    assert pose.grad is not None and pose.grad.isfinite().all() and pose.grad.abs().sum() > 0


def test_unscented_projection_culled_gaussians_have_no_gradient():
    given = scene(count=6)
    given["means"][0, 0] = math.nan
    given["means"][1] = torch.tensor([0, 0, -3.0])
    given["means"][2] = torch.tensor([9.0, 0, 2])
    given["quats"][3] = 0
    given["opacities"][4] = 1e-3
    for each in given.values():
        each.requires_grad_()
    out = fully_fused_projection_with_ut(**given, width=W, height=H, **DISTORTED)
    assert (out.radii[0, :, 0] > 0).tolist() == [False] * 5 + [True]
    (out.means2d.sum() + out.conics.sum() + out.depths.sum()).backward()
    for name in ("means", "quats", "scales"):
        assert given[name].grad is not None
        assert (given[name].grad[:5] == 0).all() and given[name].grad[5].abs().sum() > 0, name


def test_unscented_margin_culls_gaussians_with_sigma_points_outside():
    given = scene(count=1, size=0.2)
    given["means"][0] = torch.tensor([0.82, 0, 1.0])  # about 8 px beyond the right border
    project = lambda **options: fully_fused_projection_with_ut(
        **given, width=W, height=H, ut_params=UnscentedTransformParameters(**options)
    )
    assert project().radii.sum() == 0
    assert project(in_image_margin_factor=0.5).radii.sum() > 0
    assert project(require_all_sigma_points_valid=False, in_image_margin_factor=0.12).radii.sum() > 0


def test_unscented_projection_of_camera_batches():
    given = scene()
    many = {
        name: value.expand(2, *value.shape)
        for name, value in given.items()
        if name in ("means", "quats", "scales", "opacities")
    }
    poses = exp(0.05 * torch.randn(2, 3, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64))
    Ks, radial = given["Ks"].expand(2, 3, 3, 3), RADIAL * torch.arange(6, dtype=torch.float64).view(2, 3, 1) / 5
    out = fully_fused_projection_with_ut(**many, viewmats=poses, Ks=Ks, width=W, height=H, radial_coeffs=radial)
    one = fully_fused_projection_with_ut(
        **given | {"viewmats": poses[1, 2:]}, width=W, height=H, radial_coeffs=radial[1, 2:]
    )
    assert torch.equal(out.radii[1, 2], one.radii[0])
    torch.testing.assert_close(out.conics[1, 2], one.conics[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"radial_coeffs": RADIAL.expand(2, 6)}, "radial_coeffs must be"),
        ({"radial_coeffs": RADIAL.float()}, "one floating-point dtype"),
        ({"rolling_shutter": RollingShutterType.ROLLING_TOP_TO_BOTTOM}, "needs viewmats_rs"),
        ({"viewmats_rs": torch.eye(4, dtype=torch.float64)[None]}, "belong to a rolling shutter"),
        ({"rolling_shutter": "sideways"}, "must be a RollingShutterType"),
        ({"camera_model": "lidar"}, "unknown camera_model"),
        ({"width": 0}, "at least 1x1 px"),
    ],
)
def test_unscented_projection_rejects_invalid_options(options, words):
    with pytest.raises(InvalidInput, match=words):
        fully_fused_projection_with_ut(**{**scene(), "width": W, "height": H, **options})


@pytest.mark.parametrize("options", [{"alpha": 0.0}, {"kappa": -3.0}, {"in_image_margin_factor": -0.1}])
def test_unscented_parameters_reject_impossible_sigma_points(options):
    with pytest.raises(InvalidInput, match="ut_params"):
        UnscentedTransformParameters(**options)
