"""`rasterization` in one native call per pass has the pictures, gradients and meta of the chain of operations."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from gsplat_core import quat_scale_to_covar_preci, rasterization, reference
from gsplat_core.rendering import rasterization as module
from gsplat_core.rendering.rasterization import step_by_step
from tests.gsplat_core.cuda.single_call_checks import assert_same, check_lists, inputs, run


@pytest.fixture
def calls(monkeypatch) -> list[bool]:
    """Record the native calls of `rasterization`: for each, if it is differentiable."""
    found: list[bool] = []
    render = module.rasterize

    def rendered(inputs, view, differentiable):
        found.append(differentiable)
        return render(inputs, view, differentiable)

    monkeypatch.setattr(module, "rasterize", rendered)
    return found


VARIANTS = [
    {},
    {"render_mode": "RGB+ED"},
    {"render_mode": "RGB+D", "rasterize_mode": "antialiased"},
    {"render_mode": "D"},
    {"render_mode": "ED", "rasterize_mode": "antialiased"},
    {"near_plane": 4.0, "far_plane": 7.0, "radius_clip": 3.0, "eps2d": 0.1},
]


@pytest.mark.parametrize("options", VARIANTS)
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("batch", "cameras"), [((), 1), ((), 3), ((2, 1), 2)])
def test_single_call_variants_equal_chain(make_scene, calls, options, packed, batch, cameras):
    scene = make_scene(150, batch, cameras, width=90, height=70)
    leaves = inputs(scene)
    seen, meta = run(rasterization, scene, leaves, packed=packed, **options)
    assert calls == [True]
    wanted, wanted_meta = run(step_by_step.rasterization, scene, leaves, packed=packed, **options)
    assert wanted["alphas"].max() > 0.3
    assert_same(seen, wanted)
    assert list(meta) == list(wanted_meta)
    same_rows = bool((meta["radii"] == wanted_meta["radii"]).all()) if not packed else False
    for name in (
        "batch_ids",
        "camera_ids",
        "gaussian_ids",
        "radii",
        "tile_width",
        "tile_height",
        "n_batches",
        "n_cameras",
    ):
        a, b = meta[name], wanted_meta[name]
        assert torch.equal(a, b) if isinstance(b, Tensor) else a == b, name
    for name in ("means2d", "depths", "conics", "opacities"):
        shown = meta["radii"][..., 0] > 0
        torch.testing.assert_close(meta[name][shown], wanted_meta[name][shown], rtol=1e-4, atol=1e-4)
    assert packed or same_rows
    check_lists(meta)


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_single_call_degrees_and_camera_models_equal_reference(make_scene, model, degree):
    scene = make_scene(80, cameras=2, model=model, degree=4)
    leaves = inputs(scene)
    seen, _ = run(rasterization, scene, leaves, sh_degree=degree, packed=False)
    exact = {name: t.detach().double().requires_grad_() for name, t in leaves.items()}
    image, alphas, _ = reference.rasterization(
        **exact, Ks=scene.Ks.cuda(), width=scene.width, height=scene.height, sh_degree=degree, packed=False
    )
    random = torch.Generator().manual_seed(3)
    weights = [torch.rand(t.shape, generator=random).cuda() for t in (image, alphas)]
    gradients = torch.autograd.grad((image * weights[0]).sum() + (alphas * weights[1]).sum(), list(exact.values()))
    wanted = {"image": image, "alphas": alphas} | dict(zip(exact, gradients, strict=True))
    assert_same(seen, {name: t.detach().float() for name, t in wanted.items()})


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("per_camera", [False, True])
def test_single_call_plain_colours_equal_chain(make_scene, calls, count, per_camera):
    scene = make_scene(120, cameras=2)
    random = torch.Generator().manual_seed(8)
    colors = torch.rand(*((2,) if per_camera else ()), 120, count, generator=random)
    background = torch.rand(2, count, generator=random).cuda()
    leaves = inputs(scene, colors=colors)
    options = {"sh_degree": None, "backgrounds": background, "render_mode": "RGB+ED", "packed": False}
    seen, _ = run(rasterization, scene, leaves, **options)
    assert calls == [True] * (count <= 3)
    assert_same(seen, run(step_by_step.rasterization, scene, leaves, **options)[0])


def test_single_call_coefficients_per_camera_equal_chain(make_scene):
    scene = make_scene(90, cameras=2)
    leaves = inputs(scene, colors=scene.sh * torch.tensor([1.0, -0.5])[:, None, None, None])
    assert_same(*(run(f, scene, leaves, packed=False)[0] for f in (rasterization, step_by_step.rasterization)))


def test_single_call_covariances_equal_chain(make_scene):
    scene = make_scene(100)
    covars, _ = quat_scale_to_covar_preci(scene.quats.float(), scene.scales.float(), compute_preci=False)
    leaves = inputs(scene, covars=covars)
    del leaves["quats"], leaves["scales"]
    options = {"quats": None, "scales": None}
    assert_same(*(run(f, scene, leaves, **options)[0] for f in (rasterization, step_by_step.rasterization)))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("count", [0, 1, 31, 33, 129])
def test_single_call_with_few_and_invisible_gaussians(make_scene, count, packed):
    scene = make_scene(count)
    behind = replace(scene, means=-scene.means)
    for each in (scene, behind):
        leaves = inputs(each)
        options = {"packed": packed, "render_mode": "RGB+ED"}
        seen, meta = run(rasterization, each, leaves, **options)
        assert_same(seen, run(step_by_step.rasterization, each, leaves, **options)[0])
        check_lists(meta)


def test_single_call_with_large_and_crowded_splats_equals_chain(make_scene):
    scene = make_scene(6000, width=200, height=40)
    scene.scales[:40] = 5.0
    scene.opacities[:] *= 0.1
    leaves = inputs(scene)
    seen, meta = run(rasterization, scene, leaves, packed=False)
    assert torch.diff(meta["isect_offsets"].flatten()).max() > 2000
    assert_same(seen, run(step_by_step.rasterization, scene, leaves, packed=False)[0])
    again, _ = run(rasterization, scene, leaves, packed=False)
    assert all(torch.equal(seen[name], again[name]) for name in seen)


def test_single_call_without_gradients_tracks_nothing(make_scene):
    scene = make_scene(100)
    leaves = inputs(scene)
    with torch.no_grad():
        image, _, meta = rasterization(
            **leaves, Ks=scene.Ks.float().cuda(), width=scene.width, height=scene.height, sh_degree=3
        )
    assert not image.requires_grad and not meta["means2d"].requires_grad
    assert torch.equal(image, run(rasterization, scene, leaves)[0]["image"])


def test_single_call_delegates_tile_size_and_subclasses_to_chain(make_scene, calls):
    scene = make_scene(20)

    class Named(torch.Tensor):
        pass

    leaves = {name: t.detach() for name, t in inputs(scene).items()}
    arguments = {"Ks": scene.Ks.float().cuda(), "width": scene.width, "height": scene.height, "sh_degree": 3}
    images = [
        rasterization(**leaves, **arguments, tile_size=8)[0],
        rasterization(**(leaves | {"means": leaves["means"].as_subclass(Named)}), **arguments)[0],
    ]
    assert not calls
    images.append(rasterization(**leaves, **arguments)[0])
    assert calls == [False]
    for image in images:
        torch.testing.assert_close(image.as_subclass(Tensor), images[2], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("packed", [False, True])
def test_single_call_delegates_other_constants_to_chain(make_scene, calls, packed):
    scene = make_scene(60)
    scene.opacities[::2] = 1.0
    scene.means[0], scene.scales[0] = (
        torch.tensor([0.1, 0.2, 2.0]),
        1.0,
    )  # before all others, and large compared with the blur
    options = {"packed": packed, "rasterize_mode": "antialiased", "render_mode": "RGB+ED"}
    leaves, shape = inputs(scene), {"width": scene.width, "height": scene.height, "sh_degree": 3}
    alphas = {}
    for version in ("1.6", "1.5.3"):
        alphas[version] = rasterization(**leaves, Ks=scene.Ks.float().cuda(), **shape, **options, constants=version)[1]
        cpu = {name: t.detach().double().cpu() for name, t in leaves.items()}
        wanted = reference.rasterization(**cpu, Ks=scene.Ks, **shape, **options, constants=version)[1]
        torch.testing.assert_close(alphas[version].double().cpu(), wanted, rtol=1e-3, atol=1e-4)
    assert calls == [True]
    assert (alphas["1.5.3"] - alphas["1.6"]).abs().max() > 1e-3


@pytest.mark.parametrize("packed", [False, True])
def test_single_call_ops_pass_opcheck(make_scene, packed):
    scene = make_scene(30, cameras=2)
    t = {name: value.detach() for name, value in inputs(scene).items()}
    Ks = scene.Ks.float().cuda()
    given = [t["means"], None, t["quats"], t["scales"], t["opacities"], t["colors"], t["viewmats"], Ks, None, None]
    sizes = ([2], [scene.width, scene.height, 0, 3, 3, 2, True, packed, True, 0], [0.3, 0.01, 1e10, 0.0])
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.rasterize.default, (given, *sizes, True))
    out = ops.rasterize(given, *sizes, True)
    own = out[14:] if packed else out[11:]
    row_of, radii, splat_ids = (own[5], own[6], own[7]) if packed else (None, out[6], out[9])
    saved = [own[0], out[4], out[8], splat_ids, own[2], own[1], row_of, None, out[1], own[4], own[3]]
    torch.library.opcheck(ops.rasterize_splats_backward.default, (saved, torch.ones_like(out[0]), None, *sizes))
    v_records, v_means2d, _ = ops.rasterize_splats_backward(saved, torch.ones_like(out[0]), None, *sizes)
    gradients = [v_records, v_means2d, None, None, None]
    needs = [True, False, False, True, True, True, True, False, False, False]
    torch.library.opcheck(ops.rasterize_inputs_backward.default, (given, radii, row_of, gradients, *sizes, needs))
    with pytest.raises(RuntimeError, match="at least one camera"):
        ops.rasterize(given, [], *sizes[1:], True)
    with pytest.raises(RuntimeError, match="quats"):
        ops.rasterize([*given[:2], t["quats"][:-1], *given[3:]], *sizes, True)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize(("count", "cameras"), [(0, 1), (150, 1), (3000, 3)])
def test_single_call_result_independent_of_reserved_capacity(make_scene, packed, training, count, cameras):
    scene = make_scene(count, cameras=cameras, width=200, height=70)
    scene.scales[: count // 20] *= 20  # footprints that a whole warp lists
    t = {name: value.detach() for name, value in inputs(scene).items()}
    Ks = scene.Ks.float().cuda()
    given = [t["means"], None, t["quats"], t["scales"], t["opacities"], t["colors"], t["viewmats"], Ks, None, None]

    def rendered(capacity: int) -> list[Tensor]:
        options = [scene.width, scene.height, 0, 3, 3, 2, False, packed, False, capacity]
        out = torch.ops.gsplat_core.rasterize(given, [cameras], options, [0.3, 0.01, 1e10, 0.0], training)
        records = 14 if packed else 11  # rows of culled Gaussians are not written
        return [each for i, each in enumerate(out) if i != records]

    exact = rendered(0)
    length = len(exact[9])
    assert (length > 0) == (count > 0)
    for capacity in (1, length // 2 + 1, max(1, length - 1), length + 1, 10 * length + 1):
        for wanted, found in zip(exact, rendered(capacity), strict=True):
            assert torch.equal(wanted, found), capacity


def test_single_call_with_growing_and_shrinking_scenes(make_scene, calls):
    scene = make_scene(500, width=120, height=90)
    for scale in (1.0, 8.0, 8.0, 0.2, 0.2, 4.0):
        leaves = inputs(scene, scales=scene.scales * scale)
        seen, meta = run(rasterization, scene, leaves, packed=False, render_mode="RGB+ED")
        assert_same(seen, run(step_by_step.rasterization, scene, leaves, packed=False, render_mode="RGB+ED")[0])
        check_lists(meta)
    assert calls == [True] * 6


def test_single_call_threads_on_separate_streams_do_not_interfere(make_scene):
    scenes = [make_scene(count, width=90, height=70) for count in (40, 400, 2000)]
    given = [{name: t.detach() for name, t in inputs(scene).items()} for scene in scenes]

    def render(index: int) -> Tensor:
        scene = scenes[index]
        shape = {"Ks": scene.Ks.float().cuda(), "width": scene.width, "height": scene.height, "sh_degree": 3}
        return rasterization(**given[index], **shape)[0]

    def repeated(index: int) -> list[Tensor]:
        with torch.cuda.stream(torch.cuda.Stream()):
            return [render(index).cpu() for _ in range(50)]

    wanted = [render(index).cpu() for index in range(len(scenes))]
    with ThreadPoolExecutor(len(scenes)) as threads:
        for picture, pictures in zip(wanted, threads.map(repeated, range(len(scenes))), strict=True):
            assert all(torch.equal(picture, each) for each in pictures)
