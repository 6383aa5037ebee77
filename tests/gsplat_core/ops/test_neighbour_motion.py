"""The compiled motion of neighbourhoods against plain torch in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import Gaussians, InvalidInput
from gsplat_core.ops.neighbour_motion import neighbour_motion
from gsplat_core.rendering.flow import STIFFNESS, deformation_gradients


def states(count: int, dtype: torch.dtype, each: int = 12) -> tuple[Gaussians, Gaussians, torch.Tensor]:
    """Return a scene at two times and neighbours, of which some coincide with their point."""
    g = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(count, *shape, generator=g, dtype=torch.float64)
    means, quats, moved, turned = draw(3) * 5 + 80, draw(4), draw(3), draw(4)
    neighbours = torch.randint(0, max(count, 1), (count, each), generator=g)
    neighbours[: count // 4] = torch.arange(count // 4)[:, None]
    rest = draw(3), draw(), draw(1, 3)
    first, second = (Gaussians(m, q, *rest).to(dtype=dtype) for m, q in ((means, quats), (means + moved, turned)))
    return first, second, neighbours


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
@pytest.mark.parametrize("each", [0, 1, 12])
def test_neighbour_motion_values_and_gradients_equal_reference(assert_near, count, each):
    results = []
    for dtype in (torch.float32, torch.float64):
        first, second, neighbours = states(count, dtype, each)
        second.requires_grad_()
        matrices = deformation_gradients(first, second, neighbours)
        weights = torch.linspace(-1, 1, matrices.numel(), dtype=torch.float64).view(matrices.shape).to(dtype)
        (matrices * weights).sum().backward()
        results.append([matrices, second.means.grad, second.quats.grad])
    for ours, exact in zip(*results, strict=True):
        assert_near(ours, exact, of_largest=1e-3)


def test_neighbour_motion_independent_of_thread_count():
    first, second, neighbours = states(5000, torch.float32)
    turned = torch.eye(3).expand(5000, 3, 3).contiguous()
    seen = []
    threads = torch.get_num_threads()
    for number in (1, 3):
        torch.set_num_threads(number)
        after = second.means.clone().requires_grad_()
        matrices = neighbour_motion(first.means, after, turned, neighbours.int(), STIFFNESS)
        matrices.square().sum().backward()
        seen.append((matrices.detach(), after.grad))
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*seen, strict=True))


# opcheck itself reads .grad of tensors that are not leaves.
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_neighbour_motion_ops_pass_opcheck():
    first, second, neighbours = states(20, torch.float32)
    turned = torch.eye(3).expand(20, 3, 3).contiguous().requires_grad_()
    ops = torch.ops.gsplat_core
    given = (first.means, second.means.requires_grad_(), turned, neighbours.int(), STIFFNESS)
    torch.library.opcheck(ops.neighbour_motion.default, given)
    backward = (first.means, neighbours.int(), STIFFNESS, torch.ones(20, 3, 3))
    torch.library.opcheck(ops.neighbour_motion_backward.default, backward)


def test_neighbour_motion_rejects_invalid_arguments():
    first, second, neighbours = states(5, torch.float32)
    turned = torch.eye(3).expand(5, 3, 3).contiguous()
    near = neighbours.int()
    for arguments, message in [
        ((first.means, second.means[:4], turned, near), r"after must be \[N, 3\] = \[5, 3\]"),
        ((first.means, second.means, turned[:, :2], near), r"turned must be \[N, 3, 3\]"),
        ((first.means, second.means, turned, neighbours), r"neighbours must be int32 \[N, K\]"),
        ((first.means.double(), second.means, turned, near), "before must be float32"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            neighbour_motion(*arguments, STIFFNESS)
    with pytest.raises(RuntimeError, match=r"neighbours must be in \[0, 5\), found -6"):
        neighbour_motion(first.means, second.means, turned, torch.full_like(near, -6), STIFFNESS)
