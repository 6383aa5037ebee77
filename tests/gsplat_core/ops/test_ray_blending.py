"""Compiled blending of ray depths against plain torch in float64."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.ray_blending import MAX_CHANNELS, blend_rays, splat_contributions
from tests.gsplat_core.ops.ray_scenes import INPUTS, assert_close, exact_contributions, ray_scene, with_bad_values


@pytest.mark.parametrize("channels", [0, 1, 3, 4, 8, 9, MAX_CHANNELS])
def test_blend_rays_with_any_number_of_channels(channels: int) -> None:
    assert_close(ray_scene(300, channels=channels))


@pytest.mark.parametrize("size", [(1, 1), (33, 50), (16, 16), (7, 100)])
@pytest.mark.parametrize("count", [0, 1, 90])
def test_blend_rays_of_any_image_size_and_few_splats(size: tuple[int, int], count: int) -> None:
    assert_close(ray_scene(count, *size))


def test_blend_rays_of_opaque_and_thin_splats() -> None:
    s = ray_scene(300)
    s.opacities[::2] = 1.0
    s.conics[1::5] = torch.tensor([1e-8, 0.0, 1e-8])
    s.conics[2::5] = torch.tensor([3.3, 0.0, 3.3])
    s.conics[3::25] = 0.0
    assert_close(s)


def test_blend_rays_skips_non_finite_splats_without_gradient() -> None:
    s, bad = with_bad_values(ray_scene(200))
    seen = assert_close(s)
    good = replace(s, **{name: getattr(s, name)[~bad] for name in INPUTS})
    wanted = good.run()
    for name, value in wanted.items():
        if name.startswith("v_"):
            assert not seen[name][bad].any()
            assert torch.equal(seen[name][~bad], value)
        else:
            assert torch.equal(seen[name], value)


def test_blend_rays_of_two_translucent_layers_and_wall_in_closed_form() -> None:
    depths = [30.0, 40.0, 50.0]
    flat = [torch.tensor([z, 0, 0, 0, 0, 0, 0, 0, 1, 0.25]) for z in depths]
    one = torch.ones(3, 1)
    blended = blend_rays(
        *(torch.full((3, 2), 0.5), torch.tensor([1e-9, 0, 1e-9]).expand(3, 3), torch.tensor([0.3, 0.5, 0.9])),
        *(torch.stack(flat), one, 1, 1, torch.zeros(1, 1, dtype=torch.int32), torch.arange(3, dtype=torch.int32)),
    )
    weights = torch.tensor([0.3, 0.35, 0.315])
    mean = float((weights * torch.tensor(depths)).sum() / weights.sum())
    assert float(blended.depths) == pytest.approx(mean, rel=1e-6)
    assert float(blended.medians) == 40.0
    assert float(blended.alphas) == pytest.approx(float(weights.sum()), rel=1e-6)
    variance = float((weights * ((torch.tensor(depths) - mean) ** 2 + 0.25)).sum() / weights.sum())
    assert float(blended.variances) == pytest.approx(variance, rel=1e-5)


@pytest.mark.parametrize("name", ["values", "alphas", "depths", "medians"])
def test_blend_rays_gradients_of_outputs_are_independent(name: str) -> None:
    s, gradients = ray_scene(120), []
    for others in (0.0, None):
        inputs = [getattr(s, each).clone().requires_grad_() for each in INPUTS]
        outputs = blend_rays(*inputs, s.width, s.height, *s.lists())
        total = getattr(outputs, name).square().sum()
        if others is not None:
            total = total + others * sum(output.sum() for output in outputs[:4])
        total.backward()
        gradients.append([each.grad for each in inputs])
    for seen, wanted in zip(*gradients, strict=True):
        assert torch.equal(seen, wanted)
    assert any(each.any() for each in gradients[0])


def test_blend_rays_independent_of_thread_count() -> None:
    s = ray_scene(3000, 300, 200)
    threads = torch.get_num_threads()
    try:
        runs = []
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            runs.append(s.run())
    finally:
        torch.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(other[name], value) for name, value in runs[0].items())


@pytest.mark.slow
def test_blend_rays_reference_passes_gradcheck() -> None:
    s = ray_scene(6, 5, 4, channels=2)
    s.conics[:] = torch.tensor([0.1, 0.02, 0.15])  # no alpha crosses a cut-off within the differences
    s.means2d[:] = torch.rand(6, 2, generator=torch.Generator().manual_seed(1)) * 4
    inputs = [getattr(s, name).double().requires_grad_() for name in INPUTS]
    lists = s.lists()
    assert torch.autograd.gradcheck(lambda *t: reference.blend_rays(*t, 5, 4, *lists)[:4], inputs, atol=1e-4)


def test_blend_rays_names_invalid_arguments() -> None:
    s = ray_scene(5)
    rest = (s.width, s.height, *s.lists())
    tensors = [getattr(s, name) for name in INPUTS]
    with pytest.raises(InvalidInput, match=r"rays must be \[N, 10\]"):
        blend_rays(*tensors[:3], s.rays[:, :9], s.values, *rest)
    with pytest.raises(InvalidInput, match=r"values must be \[5, D\] with D up to 15"):
        blend_rays(*tensors[:4], torch.zeros(5, 16), *rest)
    with pytest.raises(InvalidInput, match="rays must be float32"):
        blend_rays(*tensors[:3], s.rays.double(), s.values, *rest)
    with pytest.raises(InvalidInput, match="do not cover the image"):
        blend_rays(*tensors, 500, 45, *rest[2:])
    for most in (0.0, 1.0, math.nan):
        with pytest.raises(InvalidInput, match="max_alpha must be from 1/255"):
            blend_rays(*tensors, *rest, max_alpha=most)
    with pytest.raises(RuntimeError, match="flatten_ids must be in"):
        blend_rays(*tensors, *rest[:3], rest[3] + 5)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
@pytest.mark.parametrize("limit", [(), (0.999,)])
def test_blend_rays_ops_pass_opcheck(limit: tuple[float, ...]) -> None:
    s = ray_scene(30, 20, 18)
    lists = s.lists()
    splats = [getattr(s, name).requires_grad_() for name in INPUTS]
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.blend_rays.default, (*splats, *lists, s.width, s.height, *limit))
    with torch.no_grad():
        plain = [tensor.detach() for tensor in splats]
        values, alphas, depths, medians, _, last, at = ops.blend_rays(*plain, *lists, s.width, s.height, *limit)
        arguments = (
            *plain,
            *lists,
            s.width,
            s.height,
            alphas,
            depths,
            last,
            at,
            values,
            alphas,
            depths,
            medians,
            *limit,
        )
        torch.library.opcheck(ops.blend_rays_backward.default, arguments)


@pytest.mark.parametrize("count", [0, 1, 200])
def test_splat_contributions_are_largest_weights(count: int) -> None:
    s = ray_scene(count)
    seen = splat_contributions(s.means2d, s.conics, s.opacities, s.width, s.height, *s.lists())
    torch.testing.assert_close(seen.double(), exact_contributions(s), rtol=1e-4, atol=1e-4, check_dtype=False)


def test_splat_contributions_op_passes_opcheck() -> None:
    s = ray_scene(30, 20, 18)
    arguments = (*(getattr(s, name) for name in INPUTS), *s.lists(), s.width, s.height)
    torch.library.opcheck(torch.ops.gsplat_core.splat_contributions.default, arguments)
