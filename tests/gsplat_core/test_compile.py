"""`torch.compile` of a render on the CPU: one graph, forward and backward, that equals the eager one."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsplat_core import rasterization


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of torch's compiler, about its own parts
def test_compiled_render_is_one_graph_and_equals_eager(make_scene, assert_compiled_equal):
    scene = make_scene(60).to(torch.float32)
    scene.sh[3, 1, 1] = math.nan  # is culled by a branch in eager mode, by a mask in a graph

    def render(*leaves: Tensor) -> tuple[Tensor, Tensor]:
        options = dict(sh_degree=3, packed=False, render_mode="RGB+ED")
        return rasterization(*leaves, scene.Ks, scene.width, scene.height, **options)[:2]

    assert_compiled_equal(render, scene.leaves(), backend="aot_eager", fullgraph=True)
