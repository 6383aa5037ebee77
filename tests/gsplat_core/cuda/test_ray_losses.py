"""Losses of rendered rays on CUDA against plain torch in float64, repeated and captured."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.ray_losses import ray_depth_loss, ray_normal_loss
from tests.gsplat_core.ops.ray_planes import compared, planes


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("size", [(37, 45), (2, 9), (0, 7), (300, 520)])
def test_ray_losses_equal_reference_and_are_deterministic(gpu, size, model):
    seen, again = (compared(size, model, gpu, torch.float32) for _ in range(2))
    for name, value in compared(size, model, "cpu", torch.float64).items():
        assert torch.equal(seen[name], again[name]), name
        scale = float(value.abs().max()) if value.numel() else 0.0
        torch.testing.assert_close(seen[name].cpu().double(), value, rtol=1e-4, atol=1e-5 * scale, msg=name)


def test_ray_losses_in_graph_read_new_depths_and_intrinsics(gpu):
    depths, alphas, normals, known, tissue, K = (each.to(gpu) for each in planes((60, 80)))

    def losses() -> tuple[torch.Tensor, ...]:
        leaves = [each.detach().requires_grad_() for each in (depths, alphas, normals)]
        loss = ray_depth_loss(leaves[0], known, tissue) + ray_normal_loss(*leaves, tissue, K, "pinhole")
        return loss.detach(), *torch.autograd.grad(loss, leaves)

    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        losses()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        replayed = losses()
    for factor in (1.0, 1.1):
        depths.mul_(factor)
        K[:2, :2].mul_(factor)
        graph.replay()
        for seen, wanted in zip(replayed, losses(), strict=True):
            assert torch.equal(seen, wanted)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_ray_losses_pass_opcheck(gpu):
    depths, alphas, normals, known, tissue, K = (each.to(gpu) for each in planes((6, 8)))
    leaves = [each.requires_grad_() for each in (depths, alphas, normals)]
    torch.library.opcheck(torch.ops.gsplat_core.ray_depth_loss.default, (leaves[0], known, tissue.view(torch.uint8)))
    torch.library.opcheck(torch.ops.gsplat_core.ray_normal_loss.default, (*leaves, tissue.view(torch.uint8), K, 0))
