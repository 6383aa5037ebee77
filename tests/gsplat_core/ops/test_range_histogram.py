"""Depth histograms against plain torch in float64 and against simple scenes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.range_histogram import Bins, range_histogram
from tests.gsplat_core.ops.range_scenes import BINS, TENSORS, assert_close, pixel_factors, run
from tests.gsplat_core.ops.ray_scenes import ray_scene, with_bad_values


@pytest.mark.parametrize("factors", [False, True])
@pytest.mark.parametrize("bins", [BINS, Bins(30.0, 0.1, 120), Bins(0.0, 200.0, 1)])
def test_range_histogram_of_random_scene(bins, factors):
    s = ray_scene(60)
    assert_close(s, bins=bins, factors=pixel_factors(s.width, s.height) if factors else None)


@pytest.mark.parametrize("size", [(1, 1), (33, 50), (7, 100)])
@pytest.mark.parametrize("count", [0, 1, 60])
def test_range_histogram_of_any_image_size_and_few_splats(size, count):
    assert_close(ray_scene(count, *size))


def test_range_histogram_of_opaque_and_thin_splats():
    s = ray_scene(120)
    s.opacities[::2] = 1.0
    s.rays[1::3, 9] = 1e-10
    seen = assert_close(s)
    assert seen["histogram"].max() > 0


def test_range_histogram_skips_non_finite_splats_without_gradient():
    s, bad = with_bad_values(ray_scene(100))
    s = replace(s, values=torch.zeros_like(s.values))
    bad = torch.stack([~getattr(s, name).reshape(100, -1).isfinite().all(1) for name in TENSORS]).any(0)
    seen = run(s)
    wanted = run(replace(s, **{name: getattr(s, name)[~bad] for name in (*TENSORS, "values")}))
    torch.testing.assert_close(seen["histogram"], wanted["histogram"], rtol=0, atol=0)
    for name in TENSORS:
        assert not seen[f"v_{name}"][bad].any()
        torch.testing.assert_close(seen[f"v_{name}"][~bad], wanted[f"v_{name}"], rtol=0, atol=0)


def test_range_histogram_of_single_splat_fills_bins_by_weight():
    s = ray_scene(1, 16, 16)
    s.means2d[:] = 8.0
    s.conics[:] = torch.tensor([1e-6, 0.0, 1e-6])
    s.opacities[:] = 0.5
    s.rays[:] = 0
    s.rays[:, 0], s.rays[:, 8], s.rays[:, 9] = 20.0, 3.0, 0.04
    out = run(s, bins=Bins(19.0, 1.0, 3))["histogram"]
    torch.testing.assert_close(out.sum(1), torch.full((16,), 8.0), rtol=1e-4, atol=0)
    torch.testing.assert_close(out[:, 0], out[:, 1], rtol=1e-3, atol=0)
    assert float(out[:, 2].max()) < 1e-4


def test_range_histogram_independent_of_thread_count():
    found, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            found.append(run(ray_scene(500, 90, 70)))
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(found[0][name], other[name]) for other in found[1:] for name in found[0])


def test_range_histogram_reference_passes_gradcheck():
    s = ray_scene(3, 6, 6)
    inputs = [getattr(s, name).double().requires_grad_() for name in TENSORS]
    inputs[0].data[:] = torch.tensor([[3.0, 3], [2, 4], [4, 1]])
    inputs[1].data[:] = torch.tensor([0.05, 0.01, 0.06])
    call = lambda *t: reference.range_histogram(*t, *s.lists(), Bins(15.0, 6.0, 10), 6, 6)
    assert torch.autograd.gradcheck(call, inputs)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")
def test_range_histogram_ops_pass_opcheck():
    s = ray_scene(8, 20, 10)
    inputs = [getattr(s, name).requires_grad_() for name in TENSORS]
    offsets, ids = s.lists()
    rest = (*BINS, 20, 10, 0.99)
    ops = torch.ops.gsplat_core
    torch.library.opcheck(ops.range_histogram, (*inputs, offsets, ids, pixel_factors(20, 10), *rest))
    plain = [t.detach() for t in inputs]
    torch.library.opcheck(ops.range_histogram_backward, (*plain, offsets, ids, None, torch.ones(20, 40), *rest))


def test_range_histogram_rejects_invalid_arguments():
    s = ray_scene(5, 20, 20)
    inputs = [getattr(s, name) for name in TENSORS]
    lists = s.lists()
    with pytest.raises(InvalidInput, match="do not cover"):
        range_histogram(*inputs, *lists, BINS, 50, 20)
    with pytest.raises(InvalidInput, match="bins must be 1 to 65536"):
        range_histogram(*inputs, *lists, Bins(0, 1, 0), 20, 20)
    with pytest.raises(InvalidInput, match=r"factors must be \[20, 20\]"):
        range_histogram(*inputs, *lists, BINS, 20, 20, factors=torch.ones(3, 20))
    with pytest.raises(InvalidInput, match=r"rays must be \[N, 10\]"):
        range_histogram(*inputs[:3], inputs[3][:, :9], *lists, BINS, 20, 20)
