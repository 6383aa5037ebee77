"""Comparison of depth histograms with plain torch in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from gsplat_core import reference
from gsplat_core.ops.range_histogram import Bins, range_histogram
from tests.gsplat_core.ops.ray_scenes import RayScene

TENSORS = ("means2d", "conics", "opacities", "rays")
BINS = Bins(15.0, 1.5, 40)


def pixel_factors(width: int, height: int) -> Tensor:
    """Return factors between 0.8 and 1.2, with zeros in a third of the pixels."""
    random = torch.Generator().manual_seed(5)
    factors = 0.8 + 0.4 * torch.rand(height, width, generator=random)
    return factors * (torch.rand(height, width, generator=random) > 0.33)


def run(
    s: RayScene, function=range_histogram, dtype=torch.float32, device="cpu", bins=BINS, factors=None
) -> dict[str, Tensor]:
    """Return the histogram and the gradients of a fixed random linear function of it, on the CPU."""
    inputs = {name: getattr(s, name).to(device, dtype, copy=True).requires_grad_() for name in TENSORS}
    lists = [tensor.to(device) for tensor in s.lists()]
    factors = None if factors is None else factors.to(device, dtype)
    out = function(*inputs.values(), *lists, bins, s.width, s.height, factors=factors, max_alpha=s.max_alpha)
    weights = torch.randn(out.shape, generator=torch.Generator().manual_seed(11)).to(out)
    total = (out * weights).sum() + sum(0 * t.nan_to_num(posinf=0, neginf=0).sum() for t in inputs.values())
    total.backward()
    return {"histogram": out.detach().cpu()} | {f"v_{name}": tensor.grad.cpu() for name, tensor in inputs.items()}


def assert_close(
    s: RayScene, device: str = "cpu", bins: Bins = BINS, factors: Tensor | None = None
) -> dict[str, Tensor]:
    """Compare with the reference: bins within 1e-3 of the largest one, gradients within 3e-3 of their norm.

    An alpha within rounding of 1/255 is skipped or not, and moves up to 1/255 of a pixel between bins.
    """
    wanted = run(s, reference.range_histogram, torch.float64, bins=bins, factors=factors)
    seen = run(s, device=device, bins=bins, factors=factors)
    largest = float(wanted["histogram"].abs().max()) if wanted["histogram"].numel() else 0.0
    off = (seen["histogram"].double() - wanted["histogram"]).abs()
    assert seen["histogram"].shape == wanted["histogram"].shape
    assert float(off.max() if off.numel() else 0) <= 1e-3 * largest + 1e-6
    for name in (f"v_{name}" for name in TENSORS):
        assert seen[name].isfinite().all(), name
        error, norm = seen[name].double() - wanted[name], wanted[name]
        columns = [slice(None)] if norm.ndim == 1 else [(slice(None), k) for k in range(norm.shape[1])]
        for column in columns:
            assert error[column].norm() <= 3e-3 * norm[column].norm() + 1e-6, (name, column)
    return seen
