"""Lenses with distortion agree with OpenCV, invert, have exact gradients, and mark what folds over."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, FThetaPolynomialType, Lens

K = np.array([[410.0, 0, 318.5], [0, 405.0, 243.0], [0, 0, 1]])
COEFFICIENTS = {
    "none": [],
    "four": [-0.31, 0.09, 1e-3, -7e-4],
    "rational": [-0.2, 0.05, 8e-4, 1e-3, -0.01, 0.02, 0.01, 0.003],
    "thin prism": [-0.25, 0.06, 8e-4, 1e-3, -0.004, 0.01, 0.0, 0.001, 2e-3, -1e-3, 1.5e-3, 5e-4],
}
FISHEYE = [0.05, -0.02, 0.004, -0.001]


def ftheta(reference: FThetaPolynomialType) -> FThetaCameraDistortionParameters:
    """Distance 400 angle + 12 angle³, and its inverse: exact only in the direction of `reference`."""
    return FThetaCameraDistortionParameters(
        reference, (0, 1 / 400, 0, -12 / 400**4, 0, 0), (0, 400, 0, 12, 0, 0), 1.2, (1.01, 2e-3, -1e-3)
    )


def points(count: int = 40) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    flat = (torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor([1.4, 1.1])
    depth = 0.5 + 3 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return torch.cat([flat * depth, depth], -1)[None]


def intrinsics() -> torch.Tensor:
    return torch.tensor(K)[None]


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_pinhole_distortion_equals_opencv(name):
    lens = Lens.from_opencv(COEFFICIENTS[name], dtype=torch.float64)
    expected, _ = cv2.projectPoints(points()[0].numpy(), np.zeros(3), np.zeros(3), K, np.array(COEFFICIENTS[name]))
    projected = lens.project(points(), intrinsics())
    assert projected.valid.all()
    np.testing.assert_allclose(projected.points[0].numpy(), expected[:, 0], atol=1e-9)


def test_fisheye_distortion_equals_opencv():
    lens = Lens.from_opencv(FISHEYE, "fisheye", dtype=torch.float64)
    expected, _ = cv2.fisheye.projectPoints(points().numpy(), np.zeros(3), np.zeros(3), K, np.array(FISHEYE))
    np.testing.assert_allclose(lens.project(points(), intrinsics()).points[0].numpy(), expected[0], atol=1e-9)


def lenses() -> dict[str, Lens]:
    double = {"dtype": torch.float64}
    return {
        **{name: Lens.from_opencv(each, **double) for name, each in COEFFICIENTS.items()},
        "fisheye": Lens.from_opencv(FISHEYE, "fisheye", **double),
        "plain fisheye": Lens("fisheye"),
        "ortho": Lens("ortho"),
        "ftheta by angle": Lens("ftheta", ftheta=ftheta(FThetaPolynomialType.ANGLE_TO_PIXELDIST)),
        "ftheta by distance": Lens("ftheta", ftheta=ftheta(FThetaPolynomialType.PIXELDIST_TO_ANGLE)),
    }


@pytest.mark.parametrize("name", lenses())
def test_lens_rays_invert_projection(name):
    lens = lenses()[name]
    pixels, valid = lens.project(points(), intrinsics())
    rays = lens.rays(pixels, intrinsics())
    assert valid.all() and rays.valid.all()
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(1, 40, dtype=torch.float64))
    along = ((points() - rays.origins) * rays.directions).sum(-1, keepdim=True)
    torch.testing.assert_close(rays.origins + along * rays.directions, points(), atol=1e-8, rtol=0)


@pytest.mark.parametrize("name", ["thin prism", "fisheye", "ftheta by distance", "ftheta by angle"])
def test_lens_projection_and_rays_pass_gradcheck(name):
    lens, few = lenses()[name], points(3)
    given = [
        each.clone().requires_grad_() for each in (lens.radial, lens.tangential, lens.thin_prism) if each is not None
    ]
    pixels = lens.project(few, intrinsics()).points

    def with_coefficients(*values):
        return Lens(lens.model, *values, ftheta=lens.ftheta) if values else lens

    torch.autograd.gradcheck(
        lambda at, Ks, *values: with_coefficients(*values).project(at, Ks).points,
        (few.requires_grad_(), intrinsics().requires_grad_(), *given), atol=1e-3, rtol=1e-4, fast_mode=True,
    )  # fmt: skip
    torch.autograd.gradcheck(
        lambda at, Ks, *values: with_coefficients(*values).rays(at, Ks).directions,
        (pixels.detach().requires_grad_(), intrinsics().requires_grad_(), *given), atol=1e-6, rtol=1e-4, fast_mode=True,
    )  # fmt: skip


def test_lens_points_folding_over_or_behind_are_invalid_and_finite():
    # r (1 - 0.5 r²) grows up to r = 0.8165.
    lens = Lens.from_opencv([-0.5, 0, 0, 0], dtype=torch.float64)
    at = torch.tensor([[[0.81, 0, 1], [0.82, 0, 1], [2.0, 0, 1], [0.1, 0, -1], [0, 0, 0]]], dtype=torch.float64)
    at.requires_grad_()
    pixels, valid = lens.project(at, intrinsics())
    assert valid.tolist() == [[True, False, False, False, False]]
    pixels.sum().backward()
    assert at.grad is not None and at.grad.isfinite().all() and pixels.isfinite().all()
    edge = 0.8165 * (1 - 0.5 * 0.8165**2)  # the largest distorted radius
    seen = torch.tensor([[[318.5 + 410 * (edge + step), 243.0] for step in (-1e-3, 1e-3)]], dtype=torch.float64)
    assert lens.rays(seen, intrinsics()).valid.tolist() == [[True, False]]
    fisheye = Lens.from_opencv([-0.2, 0, 0, 0], "fisheye")  # grows up to an angle of sqrt(1 / 0.6)
    directions = torch.tensor([[[np.sin(a), 0, np.cos(a)] for a in (1.28, 1.30)]], dtype=torch.float32)
    assert fisheye.project(directions, intrinsics().float()).valid.tolist() == [[True, False]]


def test_lens_coefficients_per_camera():
    radial = torch.zeros(2, 3, 6, dtype=torch.float64)
    radial[..., 0] = torch.arange(6).view(2, 3) * -0.05
    at, Ks = points(4).expand(2, 3, 4, 3), intrinsics().expand(2, 3, 3, 3)
    together = Lens(radial=radial).project(at, Ks).points
    alone = Lens(radial=radial[1, 2][None]).project(points(4), intrinsics()).points
    torch.testing.assert_close(together[1, 2], alone[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"model": "lidar"}, "unknown camera_model"),
        ({"radial": torch.zeros(1, 4)}, r"\[..., C, 6\]"),
        ({"model": "fisheye", "tangential": torch.zeros(1, 2)}, "do not belong"),
        ({"model": "ftheta"}, "needs ftheta_coeffs"),
        ({"ftheta": ftheta(FThetaPolynomialType.ANGLE_TO_PIXELDIST)}, "use camera_model='ftheta'"),
    ],
)
def test_lens_rejects_coefficients_of_other_models(options, words):
    with pytest.raises(InvalidInput, match=words):
        Lens(**options)
