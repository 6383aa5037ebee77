"""Depth labels of a picture by a plane sweep (Collins 1996) over given homographies and semi-global matching (Hirschmüller
2008), on the CPU.

Each call uses one thread and releases the interpreter lock, so that callers may compute several pictures concurrently.
`gsplat_core.reference.plane_sweep` computes both steps in plain torch.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled ops
from gsplat_core.ops.arguments import require_shape

WINDOW_PX = 7
"""Side in pixels of the square window in which two pictures are correlated."""
COST_STEPS = 20000
"""Integer units of `MatchingCosts.costs` per matching cost of 1."""
DISAGREES = 0.5
"""Cost of uncorrelated patches and upper bound of any cost, so that an occluded view cannot outvote the other views."""
MOST_SIDE, MOST_LABELS, MOST_VIEWS = 4094, 4096, 255
"""Longest side in pixels, and largest numbers of labels and views of a sweep."""


class MatchingCosts(NamedTuple):
    """Matching costs of D labels at each pixel."""

    costs: Tensor
    """int16 [H, W, D], mean of (1 - ZNCC) / 2 over the views in units of 1 / `COST_STEPS`, from 0 to `DISAGREES`."""
    votes: Tensor
    """uint8 [H, W, D], number of views whose correlation is above 0.6."""


class Planes(NamedTuple):
    """Best label of each pixel."""

    labels: Tensor
    """float32 [H, W] from 0 to D - 1, with sub-label precision by a parabola fit."""
    unique: Tensor
    """float32 [H, W], the relative increase of the aggregated cost at the best label more than two steps away; infinite if
    there is none.
    """
    cost: Tensor
    """float32 [H, W], matching cost of the nearest label, 0 to `DISAGREES`."""
    agreeing: Tensor
    """uint8 [H, W], number of agreeing views at the nearest label."""


def sweep_planes(
    reference: Tensor, usable: Tensor, views: Tensor, views_usable: Tensor, homographies: Tensor
) -> MatchingCosts:
    """Compute matching costs by zero-mean normalised cross-correlation, which is invariant to the brightness changes of
    a moving light.

    Correlations are computed in a window of `WINDOW_PX`, with noise of 2 grey levels added to the variances so that patches
    without contrast do not correlate. Pictures are reflected at the border of the reference (OpenCV's BORDER_REFLECT_101).
    Warped views are interpolated bilinearly and rounded to 1/32 grey level; they are black outside of their picture.

    Args:
        reference: grey picture whose depth is wanted, uint8 [H, W].
        usable: uint8 [H, W], 0 at pixels whose windows are not compared with any view.
        views: grey pictures to compare with, uint8 [V, H, W].
        views_usable: uint8 [V, H, W], 0 at pixels of a view whose windows are not compared.
        homographies: float64 [D, V, 3, 3], from pixels of the reference to pixels of each view for each label, with pixel
            centres at integers. Points with a third coordinate of 0 or less are behind the view's camera.

    Returns:
        Costs and votes, averaged and counted over the views with an interpolated mask above 0.99 at the pixel. Without such a
        view the cost is `DISAGREES`.

    Raises:
        InvalidInput: for wrong shapes, sizes or dtypes, or tensors that are not contiguous or not on the CPU.
    """
    for name, values in (
        ("reference", reference), ("usable", usable), ("views", views), ("views_usable", views_usable),
    ):  # fmt: skip
        _check(name, values, torch.uint8)
    _check("homographies", homographies, torch.float64)
    if reference.ndim != 2:
        raise InvalidInput(f"reference must be [H, W], got {list(reference.shape)}")
    _check_size("reference", *reference.shape)
    if views.ndim != 3 or not 0 < len(views) <= MOST_VIEWS:
        raise InvalidInput(f"views must be [V, H, W] with 1 to {MOST_VIEWS} views, got {list(views.shape)}")
    if homographies.ndim != 4 or not 0 < len(homographies) <= MOST_LABELS:
        raise InvalidInput(
            f"homographies must be [D, V, 3, 3] with 1 to {MOST_LABELS} labels, got {list(homographies.shape)}"
        )
    size = tuple(reference.shape)
    require_shape("usable", usable, size, "[H, W]")
    require_shape("views", views, (len(views), *size), "[V, H, W]")
    require_shape("views_usable", views_usable, (len(views), *size), "[V, H, W]")
    require_shape("homographies", homographies, (len(homographies), len(views), 3, 3), "[D, V, 3, 3]")
    return MatchingCosts(*torch.ops.gsplat_core.sweep_planes(reference, usable, views, views_usable, homographies))


def select_planes(costs: MatchingCosts) -> Planes:
    """Select the label with the lowest cost for each pixel, after semi-global matching along four paths.

    The penalties are 0.02 for a difference of one label between neighbours and 0.1 for several. Of equally good labels the
    lowest one is selected.

    Raises:
        InvalidInput: for wrong shapes, sizes or dtypes, or tensors that are not contiguous or not on the CPU.
        RuntimeError: a cost is out of range.
    """
    _check("costs", costs.costs, torch.int16)
    _check("votes", costs.votes, torch.uint8)
    if costs.costs.ndim != 3 or not 0 < costs.costs.shape[2] <= MOST_LABELS:
        raise InvalidInput(f"costs must be [H, W, D] with 1 to {MOST_LABELS} labels, got {list(costs.costs.shape)}")
    _check_size("costs", *costs.costs.shape[:2])
    require_shape("votes", costs.votes, tuple(costs.costs.shape), "[H, W, D]")
    return Planes(*torch.ops.gsplat_core.select_planes(*costs))


def _check(name: str, values: Tensor, dtype: torch.dtype) -> None:
    if not isinstance(values, Tensor):
        raise InvalidInput(f"{name} must be a tensor, got {type(values).__name__}; convert it by torch.as_tensor")
    if values.dtype != dtype or values.device.type != "cpu":
        raise InvalidInput(f"{name} must be {dtype} on the CPU, got {values.dtype} on {values.device}")
    if not values.is_contiguous():
        raise InvalidInput(
            f"{name} must be contiguous, got strides {list(values.stride())}; copy it by Tensor.contiguous"
        )


def _check_size(name: str, height: int, width: int) -> None:
    if not 0 < height <= MOST_SIDE or not 0 < width <= MOST_SIDE:
        raise InvalidInput(f"{name} must have 1 to {MOST_SIDE} pixels on a side, got {width} x {height}")


@torch.library.register_fake("gsplat_core::sweep_planes")
def _sweep_fake(
    reference: Tensor, usable: Tensor, views: Tensor, views_usable: Tensor, homographies: Tensor
) -> tuple[Tensor, Tensor]:
    size = (*reference.shape, homographies.shape[0])
    return reference.new_empty(size, dtype=torch.int16), reference.new_empty(size)


@torch.library.register_fake("gsplat_core::select_planes")
def _select_fake(costs: Tensor, votes: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    size = costs.shape[:2]
    labels, unique, cost = (costs.new_empty(size, dtype=torch.float32) for _ in range(3))
    return labels, unique, cost, votes.new_empty(size)
