"""Stereo matching in plain torch, test reference of three compiled ops.

`gsplat_core.ops.stereo_matching`: integer semi-global matching (Hirschmüller 2008). `gsplat_core.ops.disparity_fit`:
refinement of disparities. `gsplat_core.ops.edge_aware_filter`: fast global smoother (Min et al. 2014).
"""

from __future__ import annotations

import torch
from torch import Tensor

SLOPE_CAP = 63
BRIGHTNESS_MOST = 129
WINDOW_RADIUS = 4
COST_SHIFT = 6
SMALL_STEP, LARGE_STEP = 12, 49
COST_MOST = 255 - LARGE_STEP
UNIQUENESS_PERCENT = 5
LEFT_RIGHT_MOST = 1
SIXTEENTHS = 16
PATCH_PIXELS, PATCH_STEP = 100, 32
JUMP_RADIUS, JUMP_MOST, HOLE_RADIUS = 5, 32, 2
UNKNOWN = torch.iinfo(torch.int32).min


def match_disparities(left: Tensor, right: Tensor, lowest: int, count: int) -> tuple[Tensor, Tensor]:
    """Match rectified grey pictures, uint8 [H, W], at `count` disparities in pixels from `lowest` on.

    Returns:
        Disparities in 1/16 px, int32 [H, W], and a mask [H, W] of pixels without jump or hole nearby.
    """
    costs = window_costs(left.long(), right.long(), lowest, count)
    messages = (
        _messages_down(costs.transpose(0, 1)).transpose(0, 1)
        + _messages_down(costs.flip(1).transpose(0, 1)).transpose(0, 1).flip(1)
        + _messages_down(costs)
        + _messages_down(costs.flip(0)).flip(0)
    )
    found = checked_winners(4 * costs + messages, lowest)
    found = without_patches(found)
    return found.int(), one_surface(found)


def window_costs(left: Tensor, right: Tensor, lowest: int, count: int) -> Tensor:
    """Return the matching cost [H, W, count] of each disparity at each pixel.

    The pixel cost is the sampling-insensitive difference (Birchfield and Tomasi 1998) of slope and
    clamped brightness, summed over a square window.
    """
    height, width = left.shape
    columns = torch.arange(width, device=left.device)[:, None] - lowest - torch.arange(count, device=left.device)
    columns = columns.clamp(0, width - 1)  # [W, count]

    def differences(a: Tensor, b: Tensor) -> Tensor:
        (a_low, a_high), (b_low, b_high) = _range(a), _range(b)
        a, a_low, a_high = (each[:, :, None] for each in (a, a_low, a_high))
        b, b_low, b_high = (each[:, columns] for each in (b, b_low, b_high))
        from_left = torch.maximum(a - b_high, b_low - a).clamp(min=0)
        from_right = torch.maximum(b - a_high, a_low - b).clamp(min=0)
        return torch.minimum(from_left, from_right)

    pixels = differences(_slope(left), _slope(right)) + differences(left, right).clamp(max=BRIGHTNESS_MOST)
    for size, dim in ((height, 0), (width, 1)):
        around = torch.arange(size, device=left.device)
        shifts = range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
        pixels = torch.stack([pixels.index_select(dim, (around + k).clamp(0, size - 1)) for k in shifts]).sum(0)
    return (pixels >> COST_SHIFT).clamp(max=COST_MOST)


def _moved(plane: Tensor, down: int, right: int) -> Tensor:
    """Return the plane sampled at an offset of (down, right) pixels, with replicated borders."""
    height, width = plane.shape
    rows = (torch.arange(height, device=plane.device) + down).clamp(0, height - 1)
    columns = (torch.arange(width, device=plane.device) + right).clamp(0, width - 1)
    return plane[rows][:, columns]


def _slope(grey: Tensor) -> Tensor:
    rise = sum(weight * (_moved(grey, down, 1) - _moved(grey, down, -1)) for down, weight in ((-1, 1), (0, 2), (1, 1)))
    return torch.as_tensor(rise).clamp(-SLOPE_CAP, SLOPE_CAP) + SLOPE_CAP


def _range(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return minimum and maximum of each value and its interpolated half-pixel neighbours in the row."""
    before, after = (values + _moved(values, 0, -1)) // 2, (values + _moved(values, 0, 1)) // 2
    least, most = torch.minimum(before, after), torch.maximum(before, after)
    return torch.minimum(values, least), torch.maximum(values, most)


def _messages_down(costs: Tensor) -> Tensor:
    """Return the costs that semi-global matching passes along the first dimension of `costs` [H, W, count] to each pixel from
    the pixels before it, without the pixel's own cost.
    """
    kept = torch.zeros_like(costs[0])
    messages = torch.zeros_like(costs)
    beyond = torch.full_like(kept[:, :1], LARGE_STEP)
    for y in range(costs.shape[0]):
        below, above = torch.cat([beyond, kept[:, :-1]], 1), torch.cat([kept[:, 1:], beyond], 1)
        messages[y] = torch.minimum(kept, torch.minimum(below, above) + SMALL_STEP)
        totals = costs[y] + messages[y]
        kept = (totals - totals.amin(1, keepdim=True)).clamp(max=LARGE_STEP)
    return messages


def checked_winners(totals: Tensor, lowest: int) -> Tensor:
    """Select the best disparity of each pixel with sub-pixel interpolation and consistency checks.

    Args:
        totals: aggregated costs [H, W, count].
        lowest: smallest disparity in pixels.

    Returns:
        Disparities in 1/16 px [H, W]; `UNKNOWN` where ambiguous or inconsistent with the right picture.
    """
    height, width, count = totals.shape
    numbers = torch.arange(count, device=totals.device)
    keys = totals * 256 + numbers  # ties select the lowest disparity
    best_key = keys.amin(2)
    best, least = best_key % 256, best_key // 256
    rival = (totals * (100 - UNIQUENESS_PERCENT) < 100 * least[..., None]) & ((numbers - best[..., None]).abs() > 1)
    padded = torch.nn.functional.pad(totals, (1, 1))
    below, above = (padded.gather(2, (best + k)[..., None])[..., 0] for k in (0, 2))
    bend = (below + above - 2 * least).clamp(min=1)
    within = torch.div((below - above) * SIXTEENTHS + bend, 2 * bend, rounding_mode="trunc")
    within = torch.where((best > 0) & (best < count - 1), within, 0)
    known = ~rival.any(2)
    found = torch.where(known, SIXTEENTHS * (best + lowest) + within, UNKNOWN)

    columns = torch.arange(width, device=totals.device)
    there = columns - lowest - best
    inside = known & (there >= 0) & (there < width)
    none = torch.iinfo(torch.int64).max
    right = torch.full((height, width + 1), none, device=totals.device)
    right.scatter_reduce_(1, torch.where(inside, there, width), torch.where(inside, best_key, none), "amin")

    def differs(disparity: Tensor) -> Tensor:
        at = columns - disparity
        seen = (at >= 0) & (at < width)
        key = right.gather(1, torch.where(seen, at, width))
        return seen & (key != none) & ((key % 256 + lowest - disparity).abs() > LEFT_RIGHT_MOST)

    place = SIXTEENTHS * columns - found
    outside = (place < 0) | (place > SIXTEENTHS * (width - 1))
    wrong = differs(found >> 4) & differs((found + SIXTEENTHS - 1) >> 4)
    return torch.where(outside | wrong, UNKNOWN, found)


def without_patches(found: Tensor) -> Tensor:
    """Invalidate small connected patches (at most `PATCH_PIXELS`) that differ from their surroundings."""
    known = found != UNKNOWN
    labels = torch.arange(found.numel(), device=found.device).reshape(found.shape)
    while True:
        before = labels
        for dim in (0, 1):
            near, far = labels.narrow(dim, 0, labels.shape[dim] - 1), labels.narrow(dim, 1, labels.shape[dim] - 1)
            size = labels.shape[dim] - 1
            linked = known.narrow(dim, 0, size) & known.narrow(dim, 1, size)
            linked &= (found.narrow(dim, 0, size) - found.narrow(dim, 1, size)).abs() <= PATCH_STEP
            least = torch.where(linked, torch.minimum(near, far), -1)
            labels = labels.clone()
            labels.narrow(dim, 0, size).copy_(torch.where(linked, least, near))
            far = labels.narrow(dim, 1, size)
            labels.narrow(dim, 1, size).copy_(torch.where(linked, torch.minimum(least, far), far))
        if torch.equal(labels, before):
            break
    sizes = torch.bincount(labels.flatten(), minlength=found.numel())
    return torch.where(sizes[labels] > PATCH_PIXELS, found, UNKNOWN)


def one_surface(found: Tensor) -> Tensor:
    """Return the mask [H, W] of pixels without a disparity jump or hole nearby."""
    known = found != UNKNOWN
    far = 1 << 40
    most, least = torch.where(known, found, -far), torch.where(known, found, far)
    hole = (~known).long()
    for dim in (0, 1):
        most, least = _most_near(most, dim, JUMP_RADIUS), -_most_near(-least, dim, JUMP_RADIUS)
        hole = _most_near(hole, dim, HOLE_RADIUS)
    return (hole == 0) & (most - least <= JUMP_MOST)


def _most_near(plane: Tensor, dim: int, radius: int) -> Tensor:
    size = plane.shape[dim]
    around = torch.arange(size, device=plane.device)
    shifts = range(-radius, radius + 1)
    return torch.stack([plane.index_select(dim, (around + k).clamp(0, size - 1)) for k in shifts]).amax(0)


STEPS, STEP_MOST, START_MOST = 3, 0.5, 0.7
RADIUS, SIGMA = 12, 4.0
RESISTANCE, OUTLIER, INDEPENDENT_PIXELS, LEAST_KNOWN = 4.0, 6.0, 20.0, 1e-3


def fit_disparities(
    left: Tensor, right: Tensor, sixteenths: Tensor, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor]:
    """Return refined disparities and their standard deviations [H, W] in pixels, in `dtype`."""
    known = sixteenths != UNKNOWN
    there = known.to(dtype)
    start = torch.where(known, sixteenths, 0).to(dtype) / 16
    bright, other = left.to(dtype), right.to(dtype)
    rises = [_moved(other, down, 1) - _moved(other, down, -1) for down in (-1, 0, 1)]
    slope = (3 * rises[0] + 10 * rises[1] + 3 * rises[2]) / 32
    share = window(there).clamp(min=LEAST_KNOWN)
    current, information, spread = start, there, there
    for _ in range(STEPS):
        seen, rise = _taken_from(other, current), _taken_from(slope, current)
        differs = there * (bright - seen)
        differs = differs - window(differs) / share
        weight = there / (1 + (differs / OUTLIER) ** 2)
        information = window(weight * rise * rise)
        step = window(weight * rise * differs) / (information + RESISTANCE)
        moved = current - step.clamp(-STEP_MOST, STEP_MOST)
        current = start + (moved - start).clamp(-START_MOST, START_MOST)
        spread = window(weight * differs * differs)
    variance = (spread + share) / (INDEPENDENT_PIXELS * information).clamp(min=1e-6)
    return torch.where(known, current, 0), torch.where(known, variance.sqrt(), torch.inf)


def window(plane: Tensor) -> Tensor:
    """Blur a plane [H, W] with a Gaussian window of standard deviation `SIGMA`, padded with zeros."""
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=plane.dtype, device=plane.device)
    taps = torch.exp(-0.5 * (offsets / SIGMA) ** 2)
    taps = taps / taps.sum()
    smooth = torch.nn.functional.conv2d(plane[None, None], taps.reshape(1, 1, -1, 1), padding=(RADIUS, 0))
    return torch.nn.functional.conv2d(smooth, taps.reshape(1, 1, 1, -1), padding=(0, RADIUS))[0, 0]


def _taken_from(plane: Tensor, disparity: Tensor) -> Tensor:
    """Sample a plane at the columns displaced by the disparities, with linear interpolation."""
    width = plane.shape[1]
    columns = (torch.arange(width, dtype=plane.dtype, device=plane.device) - disparity).clamp(0, width - 1)
    first = columns.floor().long()
    values, later = plane.gather(1, first), plane.gather(1, (first + 1).clamp(max=width - 1))
    return values + (columns - first) * (later - values)


ROUNDS, ATTENUATION = 3, 0.25


def smooth_within_edges(planes: Tensor, guide: Tensor, strength: float, grey_step: float) -> Tensor:
    """Smooth planes [C, H, W] of any floating dtype, solving each line as a dense system."""
    seen = guide.to(planes.dtype).reshape(*guide.shape[:2], -1)
    for _ in range(ROUNDS):
        planes = _along_rows(planes, seen, strength, grey_step)
        planes = _along_rows(planes.transpose(1, 2), seen.transpose(0, 1), strength, grey_step).transpose(1, 2)
        strength *= ATTENUATION
    return planes.contiguous()


def _along_rows(planes: Tensor, seen: Tensor, strength: float, grey_step: float) -> Tensor:
    links = strength * torch.exp(-(seen[:, 1:] - seen[:, :-1]).square().sum(2).sqrt() / grey_step)  # [H, W - 1]
    before, after = torch.nn.functional.pad(links, (1, 0)), torch.nn.functional.pad(links, (0, 1))
    systems = torch.diag_embed(1 + before + after) - torch.diag_embed(links, 1) - torch.diag_embed(links, -1)
    factors = torch.linalg.cholesky(systems)
    return torch.cholesky_solve(planes.permute(1, 2, 0), factors).permute(2, 0, 1)
