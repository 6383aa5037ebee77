"""Projection on CUDA against the reference in float64, for ordinary and invalid scenes."""

from dataclasses import fields, replace

import pytest
import torch

from gsplat_core import InvalidInput, fully_fused_projection, reference

MODELS = ("pinhole", "ortho", "fisheye")


def to_gpu(scene, gpu):
    scene = scene.to(torch.float32)
    names = [f.name for f in fields(scene) if f.name not in ("width", "height")]
    return replace(scene, **{name: getattr(scene, name).to(gpu) for name in names})


def project(function, scene, covars=False, **options):
    """The projection, and the gradients of a random weighting of its outputs; all on the CPU."""
    leaves = [scene.means, scene.quats, scene.scales, scene.viewmats]
    geometry = (None, scene.quats, scene.scales)
    if covars:
        triu = reference.quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False, triu=True)[0]
        geometry = (triu.detach(), None, None)
        leaves = [scene.means, geometry[0], scene.viewmats]
    for leaf in leaves:
        leaf.requires_grad_()
    out = function(
        scene.means, *geometry, scene.viewmats, scene.Ks, scene.width, scene.height,
        **({"opacities": scene.opacities} | options),
    )  # fmt: skip
    g = torch.Generator().manual_seed(5)
    terms = [(t * torch.rand(t.shape, generator=g, dtype=torch.float64).to(t)).sum() for t in out[1:] if t is not None]
    torch.stack(terms).sum().backward()
    return [None if t is None else t.cpu() for t in out], [leaf.grad.cpu() for leaf in leaves]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("options", [{}, {"calc_compensations": True}, {"covars": True, "eps2d": 0.1}])
@pytest.mark.parametrize(("count", "batch", "cameras"), [(1100, (), 1), (300, (2,), 3), (1, (), 2), (0, (), 1)])
def test_projection_values_and_gradients_equal_reference(
    gpu, make_scene, assert_near, model, options, count, batch, cameras
):
    scene = make_scene(count, batch, cameras, model)
    ours, gradients = project(fully_fused_projection, to_gpu(scene, gpu), camera_model=model, **options)
    exact, expected = project(reference.fully_fused_projection, scene, camera_model=model, **options)
    # A radius is rounded up: one that is a whole number to rounding may fall on either side.
    assert int((ours[0] - exact[0]).abs().max() if count else 0) <= 1
    assert torch.equal(ours[0] > 0, exact[0] > 0)
    for actual, wanted in zip(ours[1:], exact[1:], strict=True):
        assert_near(actual, wanted)
    for actual, wanted in zip(gradients, expected, strict=True):
        assert_near(actual, wanted, of_largest=1e-4)


def test_projection_culls_invalid_gaussians_with_zero_gradient(gpu, make_scene):
    scene = to_gpu(make_scene(12), gpu)
    with torch.no_grad():
        scene.means[0] = torch.nan
        scene.means[1, 2] = torch.inf
        scene.quats[2] = 0
        scene.scales[3] = torch.inf
        scene.opacities[4] = torch.nan
        scene.means[5, 2] = -5
        scene.scales[6] = 1e25
    out, gradients = project(fully_fused_projection, scene)
    assert (out[0][0, :7] == 0).all() and (out[0][0, 7:] > 0).any()
    for t in (*out[1:4], *gradients):
        assert t.isfinite().all()
    for t in gradients[:3]:
        assert (t[:7] == 0).all()


def test_projection_culls_gaussians_behind_camera(gpu, make_scene):
    scene = make_scene(50)
    out, gradients = project(fully_fused_projection, to_gpu(replace(scene, means=scene.means * 0 - 5), gpu))
    assert not out[0].any() and not any(t.any() for t in gradients)


def test_projection_gradients_are_deterministic(gpu, make_scene):
    runs = [project(fully_fused_projection, to_gpu(make_scene(20_000, (), 3), gpu))[1] for _ in range(3)]
    for gradients in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(gradients, runs[0], strict=True))


def test_projection_on_current_stream_and_in_graph(gpu, make_scene):
    scene = to_gpu(make_scene(5000), gpu)
    arguments = (scene.means, None, scene.quats, scene.scales, scene.viewmats, scene.Ks, scene.width, scene.height)
    expected = fully_fused_projection(*arguments)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        on_side = fully_fused_projection(*arguments)
    torch.cuda.current_stream().wait_stream(stream)
    assert all(torch.equal(a, b) for a, b in zip(on_side[:4], expected[:4], strict=True))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):  # a host that waited would be refused here
        replayed = fully_fused_projection(*arguments)
    scene.means[:, 0] += 0.25
    graph.replay()
    moved = fully_fused_projection(*arguments)
    assert not torch.equal(moved[1], expected[1])
    assert all(torch.equal(a, b) for a, b in zip(replayed[:4], moved[:4], strict=True))


def test_projection_accepts_non_contiguous_inputs(gpu, make_scene):
    scene = to_gpu(make_scene(200), gpu)
    expected, wanted = project(fully_fused_projection, scene)
    strided = {n: getattr(scene, n).detach().T.contiguous().T for n in ("means", "quats", "scales")}
    assert not strided["means"].is_contiguous()
    out, gradients = project(fully_fused_projection, replace(scene, **strided))
    for a, b in zip((*out[:4], *gradients[:3]), (*expected[:4], *wanted[:3]), strict=True):
        assert torch.equal(a, b)


def test_projection_rejects_invalid_inputs(gpu, make_scene):
    scene = to_gpu(make_scene(5), gpu)
    with pytest.raises(InvalidInput, match="one device"):
        project(fully_fused_projection, replace(scene, viewmats=scene.viewmats.cpu()))
    with pytest.raises(InvalidInput, match=r"gsplat_core\.reference"):
        project(fully_fused_projection, replace(scene, **{
            n: getattr(scene, n).detach().double() for n in ("means", "quats", "scales", "viewmats", "Ks", "opacities")
        }))  # fmt: skip


@pytest.mark.parametrize("floor", [(), (0.0,)])
def test_projection_ops_pass_opcheck(gpu, make_scene, floor):
    scene = to_gpu(make_scene(10), gpu)
    leaves = [t[None].detach().requires_grad_() for t in (scene.means, scene.quats, scene.scales, scene.viewmats)]
    torch.library.opcheck(
        torch.ops.gsplat_core.project_gaussians,
        (
            leaves[0],
            None,
            leaves[1],
            leaves[2],
            None,
            leaves[3],
            scene.Ks[None],
            52,
            37,
            0.3,
            0.01,
            1e10,
            0.0,
            True,
            0,
            *floor,
        ),
    )
    means, quats, scales, viewmats = (t.detach() for t in leaves)
    ops, size = torch.ops.gsplat_core, (52, 37, 0.3)
    seen = ops.project_gaussians(
        means, None, quats, scales, None, viewmats, scene.Ks[None], *size, 0.01, 1e10, 0.0, True, 0, *floor
    )
    covars = reference.quat_scale_to_covar_preci(quats, scales, compute_preci=False, triu=True)[0]
    for geometry in ((None, quats, scales), (covars, None, None)):
        inputs = (means, *geometry, viewmats, scene.Ks[None], seen[4])
        torch.library.opcheck(ops.project_gaussians_backward.default, (*inputs, *seen[:4], *size, 0, True, *floor))
        torch.library.opcheck(
            ops.project_gaussians_backward.default, (*inputs, seen[0], None, None, None, *size, 1, False, *floor)
        )
