"""Keywords and render modes that gsplat 1.6 has and 1.5.3 does not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsplat_core import InvalidInput, rasterization, reference

WIDTH, HEIGHT = 40, 24
N = 24


def scene(dtype: torch.dtype = torch.float32, cameras: int = 2) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    random = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[1:, 0, 3] = 0.3
    K = torch.tensor([[30.0, 0, 20], [0, 32, 12], [0, 0, 1]], dtype=torch.float64).repeat(cameras, 1, 1)
    values = {
        "means": random(N, 3) * torch.tensor([3.0, 2, 2]) + torch.tensor([-1.5, -1, 3]),
        "quats": random(N, 4) - 0.5,
        "scales": 0.05 + 0.4 * random(N, 3),
        "opacities": 0.1 + 0.8 * random(N),
        "colors": random(N, 3),
        "viewmats": viewmats,
        "Ks": K,
    }
    return {name: value.to(dtype) for name, value in values.items()}


def plate(distance: float, tilt: float) -> dict[str, Tensor]:
    """One camera that sees one wide, flat, nearly opaque Gaussian, turned by `tilt` radians about x."""
    half = torch.tensor(tilt / 2)
    return {
        "means": torch.tensor([[0.0, 0, distance]]),
        "quats": torch.stack([half.cos(), half.sin(), torch.tensor(0.0), torch.tensor(0.0)])[None],
        "scales": torch.tensor([[30.0, 30.0, 1e-3]]),
        "opacities": torch.tensor([0.99]),
        "colors": torch.ones(1, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[30.0, 0, 20], [0, 32, 12], [0, 0, 1]]]),
    }


def rays() -> Tensor:
    x = (torch.arange(WIDTH) + 0.5 - 20) / 30
    y = (torch.arange(HEIGHT) + 0.5 - 12) / 32
    return torch.stack([x.expand(HEIGHT, -1), y[:, None].expand(-1, WIDTH), torch.ones(HEIGHT, WIDTH)], -1)


def test_distance_to_tilted_plate_is_measured_along_ray():
    distance, alphas, meta = rasterization(
        **plate(2.0, 0.5), width=WIDTH, height=HEIGHT, render_mode="Ed", return_normals=True
    )
    normal = torch.tensor([0.0, -torch.sin(torch.tensor(0.5)), torch.cos(torch.tensor(0.5))])
    expected = 2.0 * normal[2] / (rays() @ normal) * rays().norm(dim=-1)
    torch.testing.assert_close(distance[0, ..., 0], expected, rtol=1e-3, atol=0)
    normals = meta["normals"][0] / alphas[0]
    torch.testing.assert_close(normals, -normal.expand_as(normals), rtol=0, atol=1e-3)


@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
def test_distance_and_normals_ignore_the_sign_of_scales_and_see_flat_gaussians(camera_model: str):
    given = plate(2.0, 0.1) | {"scales": torch.tensor([[1.0, 1.2, 1e-6]])}
    if camera_model == "ortho":
        given["Ks"] = given["Ks"] * torch.tensor([[0.3, 1, 1], [1, 0.3, 1], [1, 1, 1]])
    options = {"width": WIDTH, "height": HEIGHT, "render_mode": "RGB-Ed", "return_normals": True}
    found = []
    for factor in ([1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 0.0]):
        scales = (given["scales"] * torch.tensor(factor)).requires_grad_()
        image, _, meta = rasterization(**(given | {"scales": scales}), camera_model=camera_model, **options)
        image.sum().backward()
        assert scales.grad is not None
        found.append((image.detach(), meta["normals"].detach(), (scales.grad * torch.tensor(factor))[:, :2]))
    assert found[0][0][..., 3].max() > 1.5 and found[0][1].any()
    for each in found[1:]:
        for one, other in zip(found[0], each, strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("cameras", [1, 2])
def test_distance_and_normals_without_gaussians_are_zero(cameras: int, packed: bool):
    given = scene(cameras=cameras)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        given[name] = given[name][:0]
    image, alphas, meta = rasterization(
        **given, width=WIDTH, height=HEIGHT, render_mode="RGB-Ed", packed=packed, return_normals=True
    )
    assert image.shape == (cameras, HEIGHT, WIDTH, 4)
    assert meta["normals"].shape == (cameras, HEIGHT, WIDTH, 3)
    assert not any(bool(values.any()) for values in (image, alphas, meta["normals"]))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("mode", ["d", "RGB-Ed"])
def test_distance_modes_match_reference(mode: str, packed: bool):
    results = []
    for function, dtype in ((rasterization, torch.float32), (reference.rasterization, torch.float64)):
        given = scene(dtype)
        leaves = {name: given[name].requires_grad_() for name in ("means", "quats", "scales", "opacities")}
        image, _, meta = function(
            **given, width=WIDTH, height=HEIGHT, render_mode=mode, packed=packed, return_normals=True, extra_signals=given["colors"]
        )  # fmt: skip
        parts = [image, meta["normals"], meta["render_extra_signals"]]
        gradients = torch.autograd.grad(sum(part.square().sum() for part in parts), list(leaves.values()))
        results.append([*(part.detach().double() for part in parts), *(each.double() for each in gradients)])
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))


def test_distance_mode_has_same_colours_as_rgb():
    plain, alphas, _ = rasterization(**scene(), width=WIDTH, height=HEIGHT)
    image, also, _ = rasterization(**scene(), width=WIDTH, height=HEIGHT, render_mode="RGB-d")
    divided, _, _ = rasterization(**scene(), width=WIDTH, height=HEIGHT, render_mode="RGB-Ed")
    torch.testing.assert_close(image[..., :3], plain)
    torch.testing.assert_close(also, alphas)
    seen = alphas[..., 0] > 0.1
    torch.testing.assert_close(divided[..., 3][seen], (image[..., 3] / alphas[..., 0])[seen])


def test_fisheye_distance_is_distance_of_centres():
    given = plate(2.0, 0.0) | {"means": torch.tensor([[1.0, 0.5, 2.0]]), "scales": torch.full((1, 3), 0.2)}
    image, alphas, _ = rasterization(**given, width=WIDTH, height=HEIGHT, render_mode="Ed", camera_model="fisheye")
    seen = alphas[..., 0] > 0.1
    assert seen.any()
    torch.testing.assert_close(image[..., 0][seen], torch.full((int(seen.sum()),), 5.25**0.5))


@pytest.mark.parametrize("packed", [False, True])
def test_extra_signals_blended_with_colour_weights(packed: bool):
    given, size = scene(), {"width": WIDTH, "height": HEIGHT, "packed": packed}
    plain, _, _ = rasterization(**given, **size)
    background = torch.full((2, 3), 0.7)
    image, _, meta = rasterization(
        **given | {"colors": given["colors"].flip(-1)}, **size, extra_signals=given["colors"], backgrounds=background,
        render_mode="RGB+ED",
    )  # fmt: skip
    torch.testing.assert_close(meta["render_extra_signals"], plain)
    assert image.shape == (2, HEIGHT, WIDTH, 4)
    features, _, _ = rasterization(**given | {"colors": given["colors"].flip(-1)}, **size, backgrounds=background)
    torch.testing.assert_close(image[..., :3], features)


def test_extra_signal_harmonics_shifted_but_not_clamped():
    given = scene()
    coefficients = torch.randn(N, 4, 5, generator=torch.Generator().manual_seed(1))
    arguments = {**given, "width": WIDTH, "height": HEIGHT}
    _, _, meta = rasterization(**arguments, extra_signals=coefficients, extra_signals_sh_degree=1)
    directions = given["means"] + torch.linalg.inv(given["viewmats"])[:, None, :3, 3] * -1
    values = [
        reference.spherical_harmonics(1, directions, coefficients[..., [each] * 3].expand(2, N, 4, 3))[..., :1] + 0.5
        for each in range(5)
    ]
    expected, _, _ = rasterization(**arguments | {"colors": torch.cat(values, -1)})
    assert (expected < 0).any()
    torch.testing.assert_close(meta["render_extra_signals"], expected)


def test_splats_sorted_by_distance_without_global_z_order():
    # The first splat has the smaller z and the larger distance.
    given = plate(2.0, 0.0) | {
        "means": torch.tensor([[3.0, 0, 2.0], [0.0, 0, 2.2]]), "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        "scales": torch.full((2, 3), 2.0), "opacities": torch.full((2,), 0.9), "colors": torch.eye(3)[:2],
    }  # fmt: skip
    for z_order, nearer in ((True, 0), (False, 1)):
        image, _, _ = rasterization(**given, width=WIDTH, height=HEIGHT, global_z_order=z_order)
        pixel = image[0, HEIGHT // 2, WIDTH // 2 + 12]
        assert pixel.argmax() == nearer


def test_depth_mode_accepts_missing_colours():
    given = scene()
    expected, _, _ = rasterization(**given, width=WIDTH, height=HEIGHT, render_mode="ED")
    found, _, _ = rasterization(**given | {"colors": None}, width=WIDTH, height=HEIGHT, render_mode="ED")
    torch.testing.assert_close(found, expected)
    with pytest.raises(InvalidInput, match="colors is None"):
        rasterization(**given | {"colors": None}, width=WIDTH, height=HEIGHT)


def test_distance_mode_requires_quats_and_scales():
    given = scene()
    covars, _ = reference.quat_scale_to_covar_preci(given["quats"], given["scales"])
    with pytest.raises(InvalidInput, match="'d' needs quats and scales"):
        rasterization(**given, width=WIDTH, height=HEIGHT, covars=covars, render_mode="d")
    given["viewmats"].requires_grad_()
    with pytest.raises(InvalidInput, match="no gradient with respect to viewmats"):
        rasterization(**given, width=WIDTH, height=HEIGHT, render_mode="d")


@pytest.mark.parametrize("name", ["lidar_coeffs", "external_distortion_coeffs"])
def test_vehicle_cameras_rejected_with_supported_models(name: str):
    with pytest.raises(NotImplementedError, match=f"{name}.*pinhole, ortho and fisheye"):
        rasterization(**scene(), width=WIDTH, height=HEIGHT, **{name: torch.zeros(3)})


def test_renderer_config_has_no_effect():
    plain, _, _ = rasterization(**scene(), width=WIDTH, height=HEIGHT)
    image, _, _ = rasterization(**scene(), width=WIDTH, height=HEIGHT, renderer_config=object(), tile_size=None)
    assert torch.equal(image, plain)


@pytest.mark.parametrize("channels", [33, 128])
def test_many_channel_features_match_reference(channels: int):
    results = []
    for function, dtype in ((rasterization, torch.float32), (reference.rasterization, torch.float64)):
        given = scene(dtype, cameras=1)
        colors = (
            torch.linspace(-1, 1, N * channels, dtype=torch.float64).reshape(N, channels).to(dtype).requires_grad_()
        )
        means = given["means"].requires_grad_()
        image, _, _ = function(**given | {"colors": colors}, width=WIDTH, height=HEIGHT)
        results.append([image.detach().double(), *(each.double() for each in torch.autograd.grad(image.square().sum(), (colors, means)))])  # fmt: skip
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max()))
