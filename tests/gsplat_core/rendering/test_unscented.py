"""`rasterization` through distorted lenses and rolling shutters."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsplat_core import (
    FThetaCameraDistortionParameters,
    FThetaPolynomialType,
    RollingShutterType,
    rasterization,
    reference,
)
from gsplat_core.errors import InvalidInput
from gsplat_core.poses.se3 import Shutter, exp

W, H = 48, 32
FTHETA = FThetaCameraDistortionParameters(
    FThetaPolynomialType.ANGLE_TO_PIXELDIST, (0, 1 / 40, 0, 0, 0, 0), (0, 40, 0, 0, 0, 0), 1.4, (1, 0, 0)
)


def scene(dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(7)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    depth = 1.5 + random(60, 1)
    made = {
        "means": torch.cat([(random(60, 2) - 0.5) * depth * torch.tensor([1.1, 0.8]), depth], -1),
        "quats": random(60, 4) - 0.5,
        "scales": 0.01 + 0.04 * random(60, 3),
        "opacities": 0.3 + 0.7 * random(60),
        "colors": random(60, 3),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor([[[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]], dtype=torch.float64),
    }
    return {name: value.to(dtype) for name, value in made.items()}


def psnr(first: Tensor, second: Tensor) -> float:
    return -10 * float((first - second).square().mean().log10())


@pytest.mark.parametrize("eval3d", [False, True])
@pytest.mark.parametrize("mode", ["RGB+ED", "D"])
def test_unscented_without_distortion_equals_ordinary_image(eval3d, mode):
    size = {"width": W, "height": H, "render_mode": mode}
    expected, _, _ = rasterization(**scene(), **size, eps2d=0.01)
    found, _, meta = rasterization(**scene(), **size, eps2d=0.01, with_ut=True, with_eval3d=eval3d)
    assert psnr(found[..., :3], expected[..., :3]) > (33 if eval3d else 45)
    assert meta["gaussian_ids"] is None and meta["radii"].shape == (1, 60, 2)


def test_fisheye_and_ftheta_of_same_lens_agree():
    size = {"width": W, "height": H, "with_ut": True, "with_eval3d": True}
    fisheye, _, _ = rasterization(**scene(), **size, camera_model="fisheye")
    given = scene()
    given["Ks"][:, :2, 2] -= 0.5  # f-theta counts from the first pixel's centre
    ftheta, _, _ = rasterization(**given, **size, camera_model="ftheta", ftheta_coeffs=FTHETA)
    torch.testing.assert_close(ftheta, fisheye, atol=2e-3, rtol=0)


@pytest.mark.parametrize("eval3d", [False, True])
def test_rolling_shutter_rows_equal_images_at_row_times(eval3d):
    given = scene()
    end = exp(torch.tensor([[0.05, -0.03, 0.02, 0.01, 0.02, 0.05]])) @ given["viewmats"]
    kind = RollingShutterType.ROLLING_TOP_TO_BOTTOM
    size = {"width": W, "height": H, "with_ut": True, "with_eval3d": eval3d}
    rolled, _, _ = rasterization(**given, **size, rolling_shutter=kind, viewmats_rs=end)
    shutter = Shutter.of(given["viewmats"], end, kind)
    rows = []
    for y in range(H):
        picture, _, _ = rasterization(**given | {"viewmats": shutter.matrices(y / (H - 1))}, **size)
        rows.append(picture[0, y])
    still, _, _ = rasterization(**given, **size)
    assert psnr(rolled[0], torch.stack(rows)) > 40 > psnr(rolled[0], still[0]) + 10


@pytest.mark.parametrize("kind", ["plain", "packed", "unscented", "eval3d"])
def test_unscented_values_and_gradients_match_reference(kind):
    results = []
    for function, dtype in ((rasterization, torch.float32), (reference.rasterization, torch.float64)):
        given = scene(dtype)
        options = {"packed": kind == "packed"}
        if kind in ("unscented", "eval3d"):
            given["radial_coeffs"] = torch.tensor([[-0.2, 0.05, 0, 0.01, 0, 0]], dtype=dtype)
            options |= {"with_ut": True, "with_eval3d": kind == "eval3d"}
        for each in given.values():
            each.requires_grad_()
        image, alphas, _ = function(
            **given, **options, width=W, height=H, render_mode="RGB+ED", rasterize_mode="antialiased"
        )
        (image.square().sum() + alphas.sum()).backward()
        results.append({"image": image.detach(), **{name: each.grad for name, each in given.items()}})
    found, expected = results
    for name, value in expected.items():
        torch.testing.assert_close(
            found[name].double(), value, rtol=2e-3, atol=2e-3 * float(value.abs().max()), msg=name
        )


@pytest.mark.parametrize("unscented", [False, True])
@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for name in ("quats", "scales") for value in (torch.nan, torch.inf, -torch.inf)]
    + [("quats", 0.0), ("scales", 0.0), ("scales", 1e-30)],
)  # fmt: skip
def test_unusable_gaussians_show_nothing_and_have_zero_gradients(name, value, unscented):
    """`scales` of 1e-30 have a finite inverse, but its square is infinite."""
    size = {"width": W, "height": H, "with_ut": unscented, "with_eval3d": True, "packed": False}
    given = scene()
    given[name][3] = value
    leaves = [given[each].requires_grad_() for each in ("means", "quats", "scales", "opacities", "colors")]
    found, alphas, _ = rasterization(**given, **size)
    without = {
        each: torch.cat([tensor[:3], tensor[4:]]) if each not in ("viewmats", "Ks") else tensor
        for each, tensor in given.items()
    }
    assert torch.allclose(found, rasterization(**without, **size)[0])
    gradients = torch.autograd.grad(found.sum() + alphas.sum(), leaves)
    for gradient in gradients:
        assert gradient.isfinite().all() and (gradient[3] == 0).all()
        assert (gradient[4:] != 0).any()


def test_rolling_shutter_harmonics_use_pose_at_middle_of_readout():
    given = scene()
    end = given["viewmats"].clone()
    end[:, 0, 3] = 0.4
    harmonics = torch.zeros(60, 4, 3)
    harmonics[:, 3, 0] = 1.0  # varies with x
    size = {"width": W, "height": H, "with_ut": True, "sh_degree": 1}
    still = exp(torch.tensor([[0.2, 0, 0, 0, 0, 0]]))
    expected, _, _ = rasterization(**given | {"colors": harmonics, "viewmats": still}, **size)
    rolled, _, meta = rasterization(
        **given | {"colors": harmonics},
        **size,
        viewmats_rs=end,
        rolling_shutter=RollingShutterType.ROLLING_TOP_TO_BOTTOM,
    )
    assert psnr(rolled[:, 15:17], expected[:, 15:17]) > 30
    torch.testing.assert_close(meta["depths"], given["means"][None, :, 2] * (meta["radii"][..., 0] > 0))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"radial_coeffs": torch.zeros(1, 6)}, InvalidInput, "need with_ut=True"),
        ({"camera_model": "ftheta", "with_ut": True}, InvalidInput, "needs ftheta_coeffs"),
        ({"with_ut": True, "viewmats_rs": torch.eye(4)[None]}, InvalidInput, "rolling_shutter"),
        ({"with_ut": True, "sparse_grad": True}, InvalidInput, "leave sparse_grad out"),
        ({"with_ut": True, "covars": torch.eye(3).expand(60, 3, 3)}, InvalidInput, "quats and scales"),
        ({"with_ut": True, "radial_coeffs": torch.zeros(1, 6), "render_mode": "Ed"}, NotImplementedError, "D and ED"),
        ({"with_eval3d": True, "render_mode": "RGB-Ed"}, NotImplementedError, "leave with_eval3d out"),
        ({"with_eval3d": True, "return_normals": True}, NotImplementedError, "leave with_eval3d out"),
    ],
)
def test_unsupported_combination_error_names_alternative(options, error, words):
    with pytest.raises(error, match=words):
        rasterization(**scene(), width=W, height=H, **options)
