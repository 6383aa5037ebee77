"""Strategies, `SelectiveAdam` and `fused_ssim` on the GPU: equal to the CPU, and deterministic."""

import copy

import pytest
import torch

from gsplat_core import DefaultStrategy, MCMCStrategy, SelectiveAdam, fused_ssim, rasterization
from gsplat_core.training.strategies.strategy import binomials, compute_relocation

COUNT = 200


def values():
    random = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, generator=random)
    return {
        "means": draw(COUNT, 3) + torch.tensor([0.0, 0.0, 4.0]), "scales": 0.3 * draw(COUNT, 3) - 2.5,
        "quats": draw(COUNT, 4), "opacities": draw(COUNT), "colors": draw(COUNT, 3).sigmoid(),
    }  # fmt: skip


def trained(strategy, device, steps=6):
    """Take steps with refinements, and return parameters and moments."""
    params = torch.nn.ParameterDict(values()).to(device)
    optimizers = {name: torch.optim.Adam([p], lr=1e-2) for name, p in params.items()}
    state = strategy.initialize_state()
    strategy.generator = torch.Generator(device).manual_seed(5)
    intrinsics = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]], device=device)
    for step in range(steps):
        colors, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
            torch.eye(4, device=device).expand(2, 4, 4), intrinsics.expand(2, 3, 3), 48, 32, packed=False,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        (colors - 0.5).square().mean().backward()
        options = {"lr": 1e-4} if isinstance(strategy, MCMCStrategy) else {}
        strategy.step_post_backward(params, optimizers, state, step, info, **options)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    return params, {name: o.state[params[name]]["exp_avg"] for name, o in optimizers.items()}


@pytest.mark.parametrize(
    "strategy",
    [
        DefaultStrategy(refine_start_iter=1, refine_every=2, reset_every=4, grow_grad2d=1e-3),
        MCMCStrategy(refine_start_iter=1, refine_every=2, min_opacity=0.2),
    ],
    ids=["adc", "mcmc"],
)
def test_strategies_with_same_seed_are_deterministic(strategy, gpu):
    first, second = (trained(copy.deepcopy(strategy), gpu) for _ in range(2))
    assert len(first[0]["means"]) > COUNT
    for one, other in zip(first, second, strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one)


def test_strategy_statistics_and_relocation_equal_cpu(gpu):
    states = {}
    for device in ("cpu", gpu):
        strategy = DefaultStrategy(refine_scale2d_stop_iter=10)
        params = torch.nn.ParameterDict(values()).to(device)
        state = strategy.initialize_state()
        colors, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), params["colors"],
            torch.eye(4, device=device)[None],
            torch.tensor([[[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]], device=device), 48, 32, packed=False,
        )  # fmt: skip
        strategy.step_pre_backward(params, {}, state, 0, info)
        colors.square().mean().backward()
        strategy.step_post_backward(params, {}, state, 0, info)
        opacities, scales = compute_relocation(
            params["opacities"].detach().sigmoid(), params["scales"].detach().exp(),
            torch.arange(1, COUNT + 1, device=device), binomials().to(device),
        )  # fmt: skip
        states[str(device)] = [
            *(state[name].cpu() for name in ("grad2d", "count", "radii")),
            opacities.cpu(),
            scales.cpu(),
        ]
    for one, other in zip(*states.values(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)


def test_selective_adam_and_fused_ssim_equal_cpu(gpu):
    random = torch.Generator().manual_seed(0)
    start, gradient = (torch.randn(50, 3, generator=random) for _ in range(2))
    visible = torch.rand(50, generator=random) < 0.5
    images = torch.rand(2, 2, 3, 20, 24, generator=random)
    ends = []
    for device in ("cpu", gpu):
        parameter = start.clone().to(device).requires_grad_()
        optimizer = SelectiveAdam([{"params": parameter, "lr": 0.1}], eps=1e-15, betas=(0.9, 0.999))
        for _ in range(3):
            parameter.grad = gradient.to(device)
            optimizer.step(visible.to(device))
        first = images[0].clone().to(device).requires_grad_()
        score = fused_ssim(first, images[1].to(device), padding="valid")
        score.backward()
        ends.append([parameter.detach().cpu(), score.detach().cpu(), first.grad.cpu()])
    for one, other in zip(*ends, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
