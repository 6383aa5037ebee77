"""Plane sweep and semi-global matching against plain torch in float64, for adversarial shapes, homographies and costs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.plane_sweep import COST_STEPS, MatchingCosts, select_planes, sweep_planes
from gsplat_core.reference import plane_sweep as reference

SIDE = st.sampled_from([1, 2, 3, 4, 5, 6, 7, 8, 9, 13, 16, 21, 33])
ROUNDING = 0.5 / COST_STEPS + 2e-4
"""Tolerance of a cost: half an integer unit, and the error that float32 positions cause at the steepest gradient."""


def noise(*size: int, seed: int = 0, blur: int = 1) -> torch.Tensor:
    """Random pictures, of which neighbouring pixels are similar with `blur`."""
    random = torch.Generator().manual_seed(seed)
    grey = torch.rand(1, *size, generator=random) * 255
    for _ in range(blur):
        grey = torch.nn.functional.avg_pool2d(grey, 3, 1, 1, count_include_pad=False)
    return grey[0].round().clamp(0, 255).byte()


def masks(*size: int, seed: int = 0) -> torch.Tensor:
    """Masks with holes; usable pixels are 7."""
    random = torch.Generator().manual_seed(seed + 100)
    return (torch.rand(size, generator=random) > 0.1).byte() * 7


def near_identity(labels: int, views: int, seed: int = 0, size: float = 1.0) -> torch.Tensor:
    """Shifts by some pixels, turns and perspective, for labels that follow each other."""
    random = torch.Generator().manual_seed(seed + 200)
    draw = lambda *shape: torch.randn(*shape, generator=random, dtype=torch.float64)
    scale = size * torch.tensor([[0.05, 0.05, 3], [0.05, 0.05, 3], [2e-3, 2e-3, 0.1]], dtype=torch.float64)
    start, change = torch.eye(3, dtype=torch.float64) + scale * draw(views, 3, 3), 0.3 * scale * draw(views, 3, 3)
    return start + torch.arange(labels)[:, None, None, None] * change


def scene(
    height: int, width: int, views: int, labels: int, seed: int = 0, size: float = 1.0
) -> tuple[torch.Tensor, ...]:
    return (
        noise(height, width, seed=seed), masks(height, width, seed=seed), noise(views, height, width, seed=seed + 1),
        masks(views, height, width, seed=seed + 1), near_identity(labels, views, seed, size),
    )  # fmt: skip


def check_costs(given: tuple[torch.Tensor, ...], most_different: float = 0.002) -> MatchingCosts:
    """Check costs and votes against the reference, but for pixels at the limit of a mask or of an agreement."""
    found, (costs, votes) = sweep_planes(*given), reference.sweep_planes(*given)
    differs = (found.costs.double() / COST_STEPS - costs).abs() > ROUNDING
    assert differs.double().mean() <= most_different
    assert (found.votes != votes).double().mean() <= most_different
    assert int(found.costs.min()) >= 0 and int(found.costs.max()) <= COST_STEPS // 2
    return found


@settings(max_examples=150, deadline=None)
@given(SIDE, SIDE, st.integers(1, 4), st.sampled_from([1, 2, 3, 5, 8, 16, 17, 33]), st.integers(0, 10**6))
@example(1, 1, 1, 1, 0)
@example(1, 33, 2, 17, 1)
@example(33, 1, 2, 17, 1)
@example(2, 2, 1, 16, 2)
def test_sweep_costs_equal_float64_reference(height, width, views, labels, seed):
    # A mask's limit is a matter of rounding at single pixels.
    check_costs(scene(height, width, views, labels, seed), most_different=0.01 + 2 / (height * width * labels))


def test_sweep_costs_of_larger_picture_equal_float64_reference():
    found = check_costs(scene(60, 150, 3, 40))
    assert 0.05 < (found.costs < COST_STEPS // 2).double().mean() < 0.95


@pytest.mark.parametrize("grey", [0, 1, 128, 255])
@pytest.mark.parametrize("other", [0, 255])
def test_sweep_costs_of_constant_pictures_are_largest(grey, other):
    flat = torch.full((20, 30), grey, dtype=torch.uint8)
    views, ones = torch.full((2, 20, 30), other, dtype=torch.uint8), torch.ones(2, 20, 30, dtype=torch.uint8)
    still = torch.eye(3, dtype=torch.float64).expand(3, 2, 3, 3).contiguous()
    found = sweep_planes(flat, ones[0], views, ones, still)
    assert bool((found.costs == COST_STEPS // 2).all()) and not found.votes.any()


@pytest.mark.parametrize("bright", [0, 250])
def test_sweep_costs_of_weak_contrast_equal_float64_reference(bright):
    """Windows of grey levels 0 to 5 and 250 to 255, where variances are small differences of large sums."""
    random = torch.Generator().manual_seed(0)
    weak = bright + torch.randint(0, 6, (3, 40, 50), generator=random, dtype=torch.uint8)
    weak[1] = weak[0].roll(1, 1)
    ones = torch.ones_like(weak)
    given = (weak[0], ones[0], weak[1:], ones[1:], near_identity(5, 2, size=0.1))
    found = check_costs(given, most_different=0)
    assert int(found.costs.min()) < 0.4 * COST_STEPS


def test_sweep_costs_after_steep_gradients_equal_float64_reference():
    """Black and white halves, after which sums over windows must be those of the window again."""
    halves = torch.zeros(40, 64, dtype=torch.uint8)
    halves[:, 20:40] = 255
    halves[10:20] = 255 - halves[10:20]
    views = torch.stack([halves, halves.roll(2, 1)])
    ones = torch.ones_like(views)
    given = (halves, ones[0], views, ones, near_identity(6, 2, size=0.2))
    found, (costs, _) = sweep_planes(*given), reference.sweep_planes(*given)
    torch.testing.assert_close(found.costs.double() / COST_STEPS, costs, rtol=0, atol=2e-3)
    # Everything is flat from 3 pixels beside an edge on.
    still = torch.eye(3, dtype=torch.float64).expand(1, 2, 3, 3).contiguous()
    flat = sweep_planes(halves, ones[0], views, ones, still)
    assert bool((flat.costs[24:, 46:] == COST_STEPS // 2).all())


def test_sweep_costs_of_shifted_picture_are_zero_at_label_of_shift():
    grey = noise(40, 50, blur=0)
    views, ones = torch.stack([grey.roll(-4, 1), grey.roll(3, 0)]), torch.ones(2, 40, 50, dtype=torch.uint8)
    homographies = torch.eye(3, dtype=torch.float64).repeat(7, 2, 1, 1)
    for label in range(7):
        homographies[label, 0, 0, 2], homographies[label, 1, 1, 2] = -label, label - 1
    found = sweep_planes(grey, ones[0], views, ones, homographies)
    inner = found.costs[4:-7, 8:-4]
    assert int(inner[..., 4].max()) < 100 and bool((found.votes[4:-7, 8:-4, 4] == 2).all())
    wrong = torch.cat([inner[..., :4], inner[..., 5:]], 2)
    assert int(wrong.min()) > 0.2 * COST_STEPS
    planes = select_planes(found)
    assert bool((planes.labels[4:-7, 8:-4] - 4).abs().max() < 0.5) and bool((planes.agreeing[4:-7, 8:-4] == 2).all())


@pytest.mark.parametrize(("gain", "cost"), [(1.0, 0.0), (0.5, 0.0), (-1.0, 0.5)])
def test_sweep_cost_is_independent_of_brightness_and_largest_for_inverted_picture(gain, cost):
    random = torch.Generator().manual_seed(0)
    grey = torch.randint(60, 190, (20, 24), generator=random)
    ones = torch.ones(1, 20, 24, dtype=torch.uint8)
    other = (gain * (grey - 125) + 100).round().byte()[None]
    found = sweep_planes(grey.byte(), ones[0], other, ones, torch.eye(3, dtype=torch.float64)[None, None])
    assert float(found.costs.max()) / COST_STEPS == pytest.approx(cost, abs=0.01)
    assert bool((found.votes == (gain > 0)).all())


def test_single_view_votes_where_cost_is_below_one_fifth():
    costs, votes = sweep_planes(*scene(40, 60, 1, 20, size=0.3))
    near = (costs - COST_STEPS // 5).abs()
    assert torch.equal((costs < COST_STEPS // 5)[near > 1], (votes == 1)[near > 1])
    assert int(near[near > 1].min()) < 20 and int(votes.max()) == 1


BEHIND = torch.diag(torch.tensor([1.0, 1, -1], dtype=torch.float64))
DEGENERATE = {
    "behind the camera": BEHIND,
    "mirrored by both signs": -torch.eye(3, dtype=torch.float64),
    "zero": torch.zeros(3, 3, dtype=torch.float64),
    "NaN": torch.full((3, 3), float("nan"), dtype=torch.float64),
    "one NaN": torch.tensor([[1, 0, 0], [0, 1, float("nan")], [0, 0, 1]], dtype=torch.float64),
    "infinite": torch.full((3, 3), float("inf"), dtype=torch.float64),
    "far to the left": torch.tensor([[1, 0, -1e30], [0, 1, 0], [0, 0, 1]], dtype=torch.float64),
    "far below": torch.tensor([[1, 0, 0], [0, 1, 1e30], [0, 0, 1]], dtype=torch.float64),
    "depth almost 0": torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 1e-300]], dtype=torch.float64),
    "not above depth 0": torch.tensor([[1, 0, 0], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_views_with_degenerate_homography_are_left_out(name):
    grey = noise(12, 20, blur=0)
    views, ones = torch.stack([grey, grey]), torch.ones(2, 12, 20, dtype=torch.uint8)
    homographies = torch.stack([DEGENERATE[name], torch.eye(3, dtype=torch.float64)])
    found = sweep_planes(grey, ones[0], views, ones, homographies[None])
    assert int(found.costs.max()) < 40 and bool((found.votes == 1).all()), "of the other view alone"
    alone = sweep_planes(grey, ones[0], views[:1], ones[:1], homographies[None, :1].contiguous())
    assert bool((alone.costs == COST_STEPS // 2).all()) and not alone.votes.any()


def test_pixels_beyond_horizon_of_homography_have_largest_cost():
    """The third coordinate changes its sign at column 10.5: pixels on one side are behind the camera."""
    horizon = torch.tensor([[1, 0, 0], [0, 1, 0], [-0.1, 0, 1.05]], dtype=torch.float64)
    grey, ones = noise(30, 40), torch.ones(1, 30, 40, dtype=torch.uint8)
    given = (grey, ones[0], noise(1, 30, 40, seed=3), ones, horizon[None, None])
    found = check_costs(given, most_different=0.01)
    assert bool((found.costs[:, 11:] == COST_STEPS // 2).all())


@pytest.mark.parametrize("scale", [1e-250, 1e-6, 1e6, 1e250])
def test_sweep_costs_are_independent_of_scale_of_homographies(scale):
    reference_, *rest, homographies = scene(20, 30, 2, 5)
    first = sweep_planes(reference_, *rest, homographies)
    scaled = sweep_planes(reference_, *rest, scale * homographies)
    assert ((first.costs - scaled.costs).abs() <= 2).double().mean() > 0.999


def test_pixel_is_unusable_with_more_than_one_percent_outside_view_or_mask():
    """A pixel may be 0.01 outside of a view, or of its mask, and not more."""
    grey, ones = noise(9, 30, blur=0), torch.ones(1, 9, 30, dtype=torch.uint8)
    shifts = torch.tensor([0, 0.009, 0.011, 0.5])
    homographies = torch.eye(3, dtype=torch.float64).repeat(4, 1, 1, 1)
    homographies[:, 0, 0, 2] = shifts
    found = sweep_planes(grey, ones[0], grey[None], ones, homographies)
    assert (found.costs[4, -1] < COST_STEPS // 2).tolist() == [True, True, False, False]
    hidden = ones.clone()
    hidden[0, :, 15] = 0
    found = sweep_planes(grey, ones[0], grey[None], hidden, homographies)
    assert (found.costs[4, 14] < COST_STEPS // 2).tolist() == [True, True, False, False]
    assert bool((found.costs[4, 15, :3] == COST_STEPS // 2).all())


def volume(height: int, width: int, labels: int, seed: int, steps: int = COST_STEPS // 2) -> MatchingCosts:
    """Random costs, which have ties if there are few steps."""
    random = torch.Generator().manual_seed(seed)
    costs = torch.randint(0, steps + 1, (height, width, labels), generator=random) * (COST_STEPS // 2 // steps)
    votes = torch.randint(0, 256, (height, width, labels), generator=random)
    return MatchingCosts(costs.short(), votes.byte())


def test_row_of_longest_side_is_matched_to_its_end():
    """A row of 4094 pixels, moved by one."""
    grey = noise(1, 4094, blur=0)
    ones = torch.ones(1, 1, 4094, dtype=torch.uint8)
    given = (grey, ones[0], grey.roll(-1, 1)[None], ones, near_identity(1, 1, size=0.0))
    given[-1][0, 0, 0, 2] = -1
    found = sweep_planes(*given)
    assert int(found.costs[0, 8:-8].max()) < 0.03 * COST_STEPS


@settings(max_examples=150, deadline=None)
@given(
    SIDE,
    SIDE,
    st.sampled_from([1, 2, 3, 4, 5, 6, 8, 15, 16, 17, 31, 32, 33, 64, 70]),
    st.integers(0, 10**6),
    st.sampled_from([1, 3, 10000]),
)
@example(1, 1, 1, 0, 10000)
@example(5, 7, 2, 0, 1)
def test_selected_labels_equal_float64_reference(height, width, labels, seed, steps):
    given = volume(height, width, labels, seed, steps)
    found, expected = select_planes(given), reference.select_planes(given)
    torch.testing.assert_close(found.labels.double(), expected.labels, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.unique.double(), expected.unique, rtol=1e-5, atol=1e-5)
    halves = ((found.labels % 1) - 0.5).abs() < 1e-4  # where the nearest label is a matter of rounding
    torch.testing.assert_close(found.cost.double()[~halves], expected.cost[~halves], rtol=0, atol=1e-6)
    assert torch.equal(found.agreeing[~halves], expected.agreeing[~halves])


def test_equal_costs_select_label_0_without_uniqueness():
    for steps in (0, COST_STEPS // 2):
        given = MatchingCosts(torch.full((6, 7, 40), steps, dtype=torch.int16), torch.ones(6, 7, 40, dtype=torch.uint8))
        found = select_planes(given)
        assert not found.labels.any() and not found.unique.any() and bool((found.agreeing == 1).all())
        assert bool((found.cost == steps / COST_STEPS).all())


def test_label_is_vertex_of_parabola_and_unique_by_cost_of_next_best_label():
    """A single pixel, whose total is four times its cost."""
    label = torch.arange(12)
    for vertex, expected, next_best in ((3.3, 3.3, 6), (6.0, 6.0, 3), (0.2, 0.0, 3), (10.9, 11.0, 8)):
        cost = 0.1 + 0.002 * (label - vertex) ** 2
        steps = (cost * COST_STEPS).round().short()[None, None]
        found = select_planes(MatchingCosts(steps, torch.zeros_like(steps).byte()))
        assert float(found.labels) == pytest.approx(expected, abs=5e-3)
        least = float(cost.min())
        assert float(found.unique) == pytest.approx(float(cost[next_best]) / least - 1, rel=2e-3)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_are_identical_with_any_number_of_threads(threads):
    given = scene(40, 50, 3, 20)
    costs = sweep_planes(*given)
    planes = select_planes(costs)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with ThreadPoolExecutor(threads) as pool:
            swept = list(pool.map(lambda _: sweep_planes(*given), range(6)))
            selected = list(pool.map(select_planes, swept))
    finally:
        torch.set_num_threads(before)
    for one, other in zip(swept, selected, strict=True):
        assert all(map(torch.equal, one, costs)) and all(map(torch.equal, other, planes))


def test_plane_sweep_ops_pass_opcheck():
    given = scene(9, 12, 2, 5)
    torch.library.opcheck(torch.ops.gsplat_core.sweep_planes.default, given)
    torch.library.opcheck(torch.ops.gsplat_core.select_planes.default, tuple(sweep_planes(*given)))


def test_sweep_planes_rejects_wrong_arguments():
    given = dict(zip(("reference", "usable", "views", "views_usable", "homographies"), scene(8, 9, 2, 3), strict=True))
    for name, value, message in [
        ("reference", given["reference"].float(), "reference must be torch.uint8 on the CPU, got torch.float32"),
        ("reference", given["reference"][:0], "reference must have 1 to 4094 pixels on a side, got 9 x 0"),
        ("reference", torch.zeros(1, 4095, dtype=torch.uint8), "reference must have 1 to 4094 pixels on a side, got 4095 x 1"),
        ("reference", given["reference"][None], r"reference must be \[H, W\]"),
        ("reference", given["reference"].numpy(), "reference must be a tensor, got ndarray"),
        ("reference", given["reference"].to("meta"), "reference must be torch.uint8 on the CPU, got torch.uint8 on meta"),
        ("usable", given["usable"][:, :8].contiguous(), r"usable must be \[H, W\] = \[8, 9\], got \[8, 8\]"),
        ("usable", given["usable"].bool(), "usable must be torch.uint8"),
        ("views", given["views"][:0], r"views must be \[V, H, W\] with 1 to 255 views, got \[0, 8, 9\]"),
        ("views", given["views"][:1], r"views_usable must be \[V, H, W\] = \[1, 8, 9\], got \[2, 8, 9\]"),
        ("views", given["views"].transpose(1, 2), "views must be contiguous, got strides"),
        ("views_usable", given["views_usable"][:, :, ::2], "views_usable must be contiguous, got strides"),
        ("homographies", given["homographies"].float(), "homographies must be torch.float64"),
        ("homographies", given["homographies"][:0], r"homographies must be \[D, V, 3, 3\] with 1 to 4096 labels"),
        ("homographies", given["homographies"][:, :1].contiguous(), r"homographies must be .* = \[3, 2, 3, 3\]"),
    ]:  # fmt: skip
        with pytest.raises(InvalidInput, match=message):
            sweep_planes(**(given | {name: value}))


def test_select_planes_rejects_wrong_arguments():
    costs, votes = volume(4, 5, 6, 0)
    for wrong, message in [
        (MatchingCosts(costs.int(), votes), "costs must be torch.int16"),
        (MatchingCosts(costs, votes.short()), "votes must be torch.uint8"),
        (MatchingCosts(costs[0], votes[0]), r"costs must be \[H, W, D\]"),
        (MatchingCosts(costs[:, :, :0], votes[:, :, :0]), r"costs must be \[H, W, D\]"),
        (MatchingCosts(costs[:, :0], votes[:, :0]), "costs must have 1 to 4094 pixels on a side, got 0 x 4"),
        (MatchingCosts(costs, votes[:3]), r"votes must be \[H, W, D\] = \[4, 5, 6\], got \[3, 5, 6\]"),
        (MatchingCosts(costs.transpose(0, 1), votes), "costs must be contiguous"),
    ]:
        with pytest.raises(InvalidInput, match=message):
            select_planes(wrong)
    for steps in (-1, COST_STEPS // 2 + 1, -32768, 32767):
        costs[2, 3, 5] = steps
        with pytest.raises(RuntimeError, match=f"costs must be 0 to {COST_STEPS // 2}, found {steps}"):
            select_planes(MatchingCosts(costs, votes))
