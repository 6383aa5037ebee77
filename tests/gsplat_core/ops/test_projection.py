"""Projection: the compiled op against the reference in float64, the reference against first principles."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core import fully_fused_projection, reference
from gsplat_core.ops.packed_projection import intrinsics_gradient

MODELS = ("pinhole", "ortho", "fisheye")


def project(function, scene, weights_seed=None, covars=False, **options):
    """The projection, and the gradients of a random weighting of its outputs."""
    leaves = [scene.means, scene.quats, scene.scales, scene.viewmats, scene.Ks]
    geometry = (None, scene.quats, scene.scales)
    if covars:
        triu = reference.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False, triu=True)[0]
        geometry = (triu.detach(), None, None)
        leaves = [scene.means, geometry[0], scene.viewmats, scene.Ks]
    if weights_seed is not None:
        for leaf in leaves:
            leaf.requires_grad_()
    out = function(
        scene.means,
        *geometry,
        scene.viewmats,
        scene.Ks,
        scene.width,
        scene.height,
        **({"opacities": scene.opacities} | options),
    )
    if weights_seed is None:
        return out, None
    g = torch.Generator().manual_seed(weights_seed)
    # Conics of small splats are huge next to the rest; weighting by their own size keeps every term visible.
    terms = [
        (t * torch.rand(t.shape, generator=g, dtype=torch.float64).to(t.dtype)).sum() for t in out[1:] if t is not None
    ]
    torch.stack(terms).sum().backward()
    return out, [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("options", [{}, {"calc_compensations": True}, {"covars": True, "eps2d": 0.1}])
@pytest.mark.parametrize(("count", "batch", "cameras"), [(60, (), 1), (37, (2,), 3), (1, (), 2), (0, (), 1)])
def test_projection_matches_reference(make_scene, assert_near, model, options, count, batch, cameras):
    scene = make_scene(count, batch, cameras, model)
    ours, gradients = project(fully_fused_projection, scene.to(torch.float32), 5, camera_model=model, **options)
    exact, expected = project(
        reference.fully_fused_projection, scene.to(torch.float64), 5, camera_model=model, **options
    )
    torch.testing.assert_close(ours.radii, exact.radii, rtol=0, atol=0)
    if count > 30:
        assert (exact.radii > 0).any() and (exact.radii == 0).any()
    for actual, wanted in zip(ours[1:], exact[1:], strict=True):
        assert_near(actual, wanted)
    for actual, wanted in zip(gradients, expected, strict=True):
        assert_near(actual, wanted, relative=5e-3, of_largest=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_projection_intrinsics_gradient_in_double_precision(make_scene, model):
    scene = make_scene(6, model=model, seed=3).to(torch.float64)
    covariances = reference.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False)[0]

    def project_with(Ks):
        return reference.fully_fused_projection(
            scene.means, None, scene.quats, scene.scales, scene.viewmats, Ks, scene.width, scene.height,
            calc_compensations=True, camera_model=model,
        )  # fmt: skip

    Ks = scene.Ks.clone().requires_grad_()
    out = project_with(Ks)
    weights = [torch.cos(torch.arange(t.numel(), dtype=torch.float64)).reshape(t.shape) for t in out[1:]]
    v_means2d, _, v_conics, v_compensations = weights
    found = intrinsics_gradient(
        scene.means, covariances, scene.viewmats, scene.Ks, out.radii, out.conics.detach(), out.compensations.detach(),
        (v_means2d, v_conics, v_compensations), (scene.width, scene.height), model, 0.005,
    )  # fmt: skip
    (expected,) = torch.autograd.grad(sum((t * w).sum() for t, w in zip(out[1:], weights, strict=True)), Ks)
    assert (out.radii > 0).any() and expected.abs().sum() > 0
    torch.testing.assert_close(found, expected)
    # Depths do not depend on the intrinsics; in fast mode torch 2.11 fails for such an output.
    torch.autograd.gradcheck(lambda Ks: [project_with(Ks)[index] for index in (1, 3, 4)], Ks, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize("model", MODELS)
def test_projected_covariance_equals_jacobian_applied_to_covariance(make_scene, model):
    scene = make_scene(20, model=model, seed=3).to(torch.float64)
    out = reference.fully_fused_projection(
        scene.means, None, scene.quats, scene.scales, scene.viewmats, scene.Ks, scene.width, scene.height,
        eps2d=0.25, camera_model=model,
    )  # fmt: skip
    covar = reference.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False)[0]
    checked = 0
    for i in (out.radii[0, :, 0] > 0).nonzero().flatten().tolist():

        def point(mean, i=i):
            one = scene.means.clone()
            one[i] = mean
            return reference.fully_fused_projection(
                one, None, scene.quats, scene.scales, scene.viewmats, scene.Ks, scene.width, scene.height,
                camera_model=model,
            ).means2d[0, i]  # fmt: skip

        J = torch.autograd.functional.jacobian(point, scene.means[i])
        u, v = out.means2d[0, i].tolist()
        if not (0 < u < scene.width and 0 < v < scene.height):
            continue  # outside, the pinhole's Jacobian is clamped
        blurred = J @ covar[i] @ J.T + 0.25 * torch.eye(2, dtype=torch.float64)
        a, b, c = out.conics[0, i]
        torch.testing.assert_close(torch.stack([torch.stack([a, b]), torch.stack([b, c])]), blurred.inverse())
        checked += 1
    assert checked >= 3


def test_pinhole_jacobian_clamped_to_1_3_fields_of_view():
    K = torch.tensor([[[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]], dtype=torch.float64)

    def conic(x):
        return reference.fully_fused_projection(
            torch.tensor([[x, 0, 1.0]], dtype=torch.float64), None, torch.tensor([[1.0, 0, 0, 0]]).double(),
            torch.tensor([[0.1, 0.1, 0.5]]).double(), torch.eye(4).double()[None], K, 100, 100, eps2d=0.0,
        ).conics[0, 0]  # fmt: skip

    # Half the field of view is 1, so beyond x = 1.3 z the ellipse stays as it is there.
    torch.testing.assert_close(conic(1.4), conic(1.8), rtol=1e-12, atol=0)
    assert (conic(1.2) - conic(1.4)).abs().max() > 1e-5


def test_projection_radii_follow_opacity_and_blur():
    def radii(sigma, opacity):
        return fully_fused_projection(
            torch.tensor([[0.0, 0, 10]]), None, torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), sigma / 10),
            torch.eye(4)[None], torch.tensor([[[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]]), 100, 100,
            opacities=torch.tensor([opacity]),
        ).radii[0, 0].tolist()  # fmt: skip

    sigma = math.sqrt(10.0**2 + 0.3)
    assert radii(10.0, 0.99) == [math.ceil(math.sqrt(2 * math.log(255 * 0.99)) * sigma)] * 2
    assert radii(10.0, 0.1) == [math.ceil(math.sqrt(2 * math.log(25.5)) * sigma)] * 2
    assert radii(10.0, 0.0039) == [0, 0]  # below 1/255


@pytest.mark.parametrize(
    ("what", "where", "value"),
    [
        ("means", 2, -3.0),  # behind the camera
        ("means", 2, 0.0),  # in its plane
        ("means", 0, 1e30),
        ("means", 0, math.nan),
        ("means", 2, math.inf),
        ("quats", slice(None), 0.0),
        ("quats", 1, math.nan),
        ("quats", 3, math.inf),
        ("scales", 1, math.nan),
        ("scales", slice(None), math.inf),
        ("scales", 0, 1e25),
        ("opacities", None, math.nan),
        ("opacities", None, math.inf),
        ("opacities", None, 0.0),
        ("opacities", None, -1.0),
    ],
)
@pytest.mark.parametrize("model", MODELS)
def test_projection_culls_invalid_gaussian_without_affecting_others(make_scene, model, what, where, value):
    scene = make_scene(20, model=model).to(torch.float32)
    scene.means[7] = torch.tensor([0.1, 0.2, 5.0])
    clean, clean_gradients = project(fully_fused_projection, scene.to(torch.float32), 3, camera_model=model)
    assert clean.radii[0, 7, 0] > 0
    broken = scene.to(torch.float32)
    getattr(broken, what)[(7,) if where is None else (7, where)] = value
    out, gradients = project(fully_fused_projection, broken, 3, camera_model=model)
    others = torch.arange(20) != 7
    assert out.radii[0, 7].tolist() == [0, 0]
    for actual, wanted in zip(out[:4], clean[:4], strict=True):
        assert (actual[0, 7] == 0).all()
        torch.testing.assert_close(actual[0, others], wanted[0, others], rtol=0, atol=0)
    for actual, wanted in zip(gradients[:3], clean_gradients[:3], strict=True):
        assert (actual[7] == 0).all()
        torch.testing.assert_close(actual[others], wanted[others], rtol=0, atol=0)
    assert gradients[3].isfinite().all()
    # The reference culls the same one (1e25 is a number in float64) and stays finite.
    exact, expected = project(reference.fully_fused_projection, broken.to(torch.float64), 3, camera_model=model)
    assert all(gradient.isfinite().all() for gradient in expected)
    if value != 1e25:
        assert exact.radii[0, 7].tolist() == [0, 0]


def test_projection_of_tiny_gaussians_equals_blur(make_scene):
    scene = make_scene(20).to(torch.float32)
    scene.scales.fill_(1e-12)
    out, gradients = project(fully_fused_projection, scene, 1)
    seen = out.radii[0, :, 0] > 0
    torch.testing.assert_close(out.conics[0, seen], torch.tensor([1 / 0.3, 0, 1 / 0.3]).expand(int(seen.sum()), 3))
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_projection_clips_near_far_and_radius(make_scene):
    scene = make_scene(60).to(torch.float32)
    everything, _ = project(fully_fused_projection, scene)
    clipped, _ = project(fully_fused_projection, scene, near_plane=5.0, far_plane=7.0, radius_clip=6.0)
    z = everything.depths
    kept = (everything.radii > 6).any(-1) & (z >= 5) & (z <= 7)
    torch.testing.assert_close(clipped.radii, everything.radii * kept[..., None])
    assert 0 < kept.sum() < (everything.radii[..., 0] > 0).sum()


def test_projection_accepts_non_contiguous_inputs(make_scene):
    scene = make_scene(30, cameras=2).to(torch.float32)
    plain, _ = project(fully_fused_projection, scene)
    strided = scene.to(torch.float32)
    object.__setattr__(strided, "means", scene.means.T.contiguous().T)
    object.__setattr__(strided, "scales", torch.cat([scene.scales, scene.scales], -1)[:, :3])
    object.__setattr__(strided, "viewmats", scene.viewmats.transpose(-1, -2).contiguous().transpose(-1, -2))
    assert not strided.means.is_contiguous() and not strided.scales.is_contiguous()
    out, _ = project(fully_fused_projection, strided)
    for actual, wanted in zip(out[:4], plain[:4], strict=True):
        torch.testing.assert_close(actual, wanted, rtol=0, atol=0)


@pytest.mark.parametrize("function", [fully_fused_projection, reference.fully_fused_projection])
def test_packed_projection_has_visible_rows(make_scene, function):
    scene = make_scene(30, (2,), 3)
    scene = scene.to(torch.float32)
    dense, _ = project(function, scene, calc_compensations=True)
    packed, _ = project(function, scene, calc_compensations=True, packed=True)
    rows = (packed.batch_ids, packed.camera_ids, packed.gaussian_ids)
    assert packed.radii.shape[0] == (dense.radii[..., 0] > 0).sum() < 2 * 3 * 30
    for name in ("radii", "means2d", "depths", "conics", "compensations"):
        torch.testing.assert_close(getattr(packed, name), getattr(dense, name)[rows], rtol=0, atol=0)
    assert (packed.radii > 0).all()


def test_projection_gradients_independent_of_thread_count(make_scene):
    scene = make_scene(5000, cameras=2)
    threads = torch.get_num_threads()
    try:
        results = []
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            results.append(project(fully_fused_projection, scene.to(torch.float32), 3)[1])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        for actual, wanted in zip(other, results[0], strict=True):
            assert torch.equal(actual, wanted)


@pytest.mark.parametrize("model", MODELS)
def test_projection_reference_passes_gradcheck(make_scene, model):
    scene = make_scene(12, cameras=2, model=model, seed=4).to(torch.float64)
    # A point near the axis takes the fisheye's series.
    scene.means[0] = torch.tensor([1e-4, 2e-4, 5.0])
    scene.viewmats[0] = torch.eye(4)
    (
        scene.means.requires_grad_(),
        scene.quats.requires_grad_(),
        scene.scales.requires_grad_(),
        scene.viewmats.requires_grad_(),
    )

    def function(means, quats, scales, viewmats):
        out = reference.fully_fused_projection(
            means, None, quats, scales, viewmats, scene.Ks, scene.width, scene.height, calc_compensations=True,
            camera_model=model,
        )  # fmt: skip
        return out[1:]

    assert torch.autograd.gradcheck(function, (scene.means, scene.quats, scene.scales, scene.viewmats), fast_mode=True)


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
@pytest.mark.parametrize("covars", [False, True])
@pytest.mark.parametrize("floor", [(), (0.0,)])
def test_projection_ops_pass_opcheck(make_scene, covars, floor):
    scene = make_scene(9, cameras=2).to(torch.float32)
    triu = reference.quat_scale_to_covar_preci(scene.quats, scene.scales, triu=True)[0]
    means, quats, scales, viewmats = (
        t[None].requires_grad_() for t in (scene.means, scene.quats, scene.scales, scene.viewmats)
    )
    geometry = (triu[None].requires_grad_(), None, None) if covars else (None, quats, scales)
    arguments = (
        means, *geometry, scene.opacities[None], viewmats, scene.Ks[None], scene.width, scene.height,
        0.3, 0.01, 1e10, 0.0, True, 2, *floor,
    )  # fmt: skip
    torch.library.opcheck(torch.ops.gsplat_core.project_gaussians, arguments)
    means2d, depths, _, compensations, radii = torch.ops.gsplat_core.project_gaussians(*arguments)
    detached = [None if t is None else t.detach() for t in (means, *geometry, viewmats)]
    torch.library.opcheck(
        torch.ops.gsplat_core.project_gaussians_backward,
        (
            *detached, scene.Ks[None], radii, means2d.detach(), depths.detach(), None, compensations.detach(),
            scene.width, scene.height, 0.3, 2, True, *floor,
        ),
    )  # fmt: skip
