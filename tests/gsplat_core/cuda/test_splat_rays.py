"""Ray coefficients and normals on CUDA against plain torch in float64."""

from __future__ import annotations

import pytest
import torch

from gsplat_core.ops.splat_rays import splat_rays
from tests.gsplat_core.ops.ray_scenes import gaussians, intrinsics, splat_results


@pytest.mark.parametrize("count", [0, 1, 7, 5000])
def test_splat_rays_equal_reference_and_are_deterministic(gpu, count):
    seen, again, wanted = splat_results(count, gpu), splat_results(count, gpu), splat_results(count, None)
    for name, value in wanted.items():
        assert torch.equal(seen[name], again[name]), name
        error = (seen[name].double() - value).norm(dim=0) if count else torch.zeros(1)
        scale = value.norm(dim=0) if count else torch.ones(1)
        assert bool((error <= 1e-3 * scale + 1e-6).all()), (name, error / scale)


@pytest.mark.parametrize("model", ["ortho", "fisheye"])
def test_splat_rays_of_other_projections_equal_cpu(gpu, model):
    tensors = [tensor.float() for tensor in (*gaussians(300), torch.eye(4), intrinsics(70, 45))]
    for seen, wanted in zip(splat_rays(*(t.to(gpu) for t in tensors), model), splat_rays(*tensors, model), strict=True):
        torch.testing.assert_close(seen.cpu(), wanted, rtol=1e-3, atol=1e-4)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")  # raised by opcheck itself
def test_splat_rays_pass_opcheck(gpu):
    inputs = [tensor.float().to(gpu).requires_grad_() for tensor in gaussians(9)]
    camera = torch.eye(4, device=gpu), intrinsics(70, 45).float().to(gpu)
    torch.library.opcheck(torch.ops.gsplat_core.splat_rays.default, (*inputs, *camera))
