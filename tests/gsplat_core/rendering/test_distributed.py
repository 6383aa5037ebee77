"""Gaussians distributed over processes: equal to pictures and gradients of one process."""

from __future__ import annotations

import pytest
import torch
import torch.distributed as dist

from benchmarks.gsplat.processes import differences, scene
from gsplat_core import InvalidInput, rasterization


@pytest.fixture
def one_process(tmp_path):
    dist.init_process_group("gloo", store=dist.FileStore(str(tmp_path / "store"), 1), rank=0, world_size=1)
    yield
    dist.destroy_process_group()


def render(**options):
    return rasterization(**scene(200, 2), width=160, height=128, sh_degree=2, **options)


@pytest.mark.slow
def test_two_processes_equal_single_process_images_and_gradients():
    found = differences(300, 4, 2, "cpu")
    assert len(found) == 14
    assert max(found.values()) < 1e-4


@pytest.mark.parametrize("packed", [True, False])
def test_distributed_single_process_equals_ordinary_image(one_process, packed):
    background = torch.tensor([[0.1, 0.2, 0.3]]).repeat(2, 1)
    options = {"packed": packed, "backgrounds": background, "render_mode": "RGB+D", "global_z_order": False}
    image, alphas, meta = render(distributed=True, **options)
    wanted, wanted_alphas, wanted_meta = render(**options)
    assert torch.equal(image, wanted) and torch.equal(alphas, wanted_alphas)
    assert meta["means2d"].shape == wanted_meta["means2d"].shape
    assert torch.equal(meta["isect_offsets"], wanted_meta["isect_offsets"])


def test_distributed_rejects_unsupported_options(one_process):
    with pytest.raises(InvalidInput, match="absgrad is not available"):
        render(distributed=True, absgrad=True)
    with pytest.raises(NotImplementedError, match="use the render modes D and ED"):
        render(distributed=True, render_mode="RGB-Ed")
    with pytest.raises(NotImplementedError, match="leave one of them out"):
        render(distributed=True, with_ut=True)
    values = scene(200, 2)
    values["colors"] = torch.rand(2, 200, 3)
    with pytest.raises(InvalidInput, match="the same for all cameras"):
        rasterization(**values, width=160, height=128, distributed=True)


def test_distributed_requires_process_group():
    with pytest.raises(InvalidInput, match="needs a process group"):
        render(distributed=True)
