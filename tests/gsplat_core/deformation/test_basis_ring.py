"""A basis field that discards its history in place, compared with a field that keeps everything."""

from __future__ import annotations

import random

import pytest
import torch

from gsplat_core import Camera, Model
from gsplat_core.deformation import BasisField, BasisRates
from gsplat_core.errors import InvalidInput
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.models import SnapshotSlots
from gsplat_core.scene.gaussians import RowMoves

RATES = BasisRates(position=0.02, centers=5e-3, widths=5e-3)
SPACING_S = 0.2
HISTORY_S = 2.0
FRAME_S = 0.0613
"""Unrelated to the spacing: at exactly 4 widths, rounding decides if a bump is active."""


def online(count: int, history_s: float | None = HISTORY_S, start_s: float = 0.0) -> BasisField:
    field = BasisField(count, (start_s, start_s + SPACING_S), bumps=4)
    if history_s is not None:
        field.keep_last(history_s)
    return field


def exact(field: BasisField) -> BasisField:
    """Convert to float64. Bumps are summed in another order, and training amplifies rounding."""
    return field.double()


def wave(count: int, time_s: float) -> torch.Tensor:
    phase = torch.arange(float(count))[:, None] + torch.arange(13.0)
    return 0.1 * torch.sin(3 * time_s + phase)


def watch(field: BasisField, time_s: float, newest_s: float, steps: int = 2, rates: BasisRates = RATES) -> None:
    """Process a frame in the order of the reconstructor."""
    field.cover(time_s, newest_s)
    for _ in range(steps):
        target = wave(field.count, time_s).to(field.weights.device)
        field.adam_step(time_s, field.deltas(time_s).detach() - target, rates)


def addresses(field: BasisField) -> list[tuple[int, tuple[int, ...]]]:
    return [(tensor.data_ptr(), tuple(tensor.shape)) for tensor in field.training_tensors()]


@pytest.mark.slow
def test_ring_equals_full_field_within_history():
    ring, everything = exact(online(6)), exact(online(6, history_s=None))
    newest = 0.0
    for frame in range(200):
        time_s = frame * FRAME_S
        for field in (ring, everything):
            field.cover(time_s, newest)
            # A gradient that does not depend on the field: training on what it shows would amplify rounding.
            field.adam_step(time_s, wave(6, 2 * time_s).double(), BasisRates(centers=0.0, widths=0.0))
        newest = time_s
    assert everything.bumps > 60 and ring.bumps == ring.columns.places < 25
    start, end = ring.time_window_s
    assert start <= newest - HISTORY_S and end == everything.time_window_s[1]
    for step in range(41):
        time_s = newest - HISTORY_S * step / 40
        torch.testing.assert_close(ring.deltas(time_s), everything.deltas(time_s), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_ring_continues_learning():
    field, newest, errors = online(6), 0.0, []
    for frame in range(1000):
        watch(field, frame * FRAME_S, newest, steps=4)
        newest = frame * FRAME_S
        errors.append(float((field.deltas(newest).detach() - wave(6, newest))[:, :3].abs().mean()))
    early, late = (sum(part) / len(part) for part in (errors[100:300], errors[800:]))
    assert late < 0.02 and late < 1.1 * early


@pytest.mark.slow
def test_ring_gradient_equals_full_field():
    ring, everything = exact(online(4)), exact(online(4, history_s=None))
    newest = 0.0
    for frame in range(110):
        for field in (ring, everything):
            watch(field, frame * FRAME_S, newest)
        newest = frame * FRAME_S
    gradients = []
    for field in (ring, everything):
        (field.deltas(newest - 1.0) * wave(4, 7.0)).sum().backward()
        gradients.append([field.columns.in_order(parameter.grad) for parameter in field.parameters()])
    for mine, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, theirs[:, -ring.bumps :], rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_ring_addresses_and_centres_constant_over_10000_columns():
    field = online(3, history_s=1.0)
    field.cover(0.0, 0.0)
    at, newest = addresses(field), 0.0
    for frame in range(10_000):
        time_s = frame * SPACING_S
        field.cover(time_s, newest)
        field.adam_step(
            time_s, torch.zeros(3, 13), RATES
        )  # no Gaussian is trained: every centre is where it was laid out
        newest = time_s
    assert addresses(field) == at
    assert torch.equal(field.columns.in_order(field.centers.data)[0], torch.arange(float(field.bumps)))
    assert 0 <= field.frame_time(newest) <= field.bumps
    assert field.columns.origin_s + field.frame_time(newest) * SPACING_S == pytest.approx(newest, abs=1e-9)


def test_ring_trained_centres_exact_when_origin_moves():
    field = online(2)
    newest = 0.0
    while field.columns.spare:
        watch(field, newest + FRAME_S, newest)
        newest += FRAME_S
    before = field.columns.in_order(field.centers.data).double()
    origin = field.columns.origin_s
    field.cover(newest + 3 * SPACING_S, newest)
    passed = round((field.columns.origin_s - origin) / SPACING_S)
    assert passed >= 2
    kept = field.columns.in_order(field.centers.data).double()[:, :-passed]
    assert torch.equal(kept, before[:, passed:] - passed)


def test_ring_holds_last_state_over_gap_longer_than_history():
    field = online(5)
    newest = 0.0
    for frame in range(60):
        watch(field, frame * FRAME_S, newest, steps=6)
        newest = frame * FRAME_S
    at, held = addresses(field), field.deltas(newest).detach()
    assert float(held.abs().max()) > 0.05
    hours_later = newest + 3 * 3600.0
    field.cover(hours_later, newest)
    assert addresses(field) == at
    torch.testing.assert_close(field.deltas(hours_later).detach(), held, rtol=1e-3, atol=1e-4)
    assert field.time_window_s[0] > newest
    watch(field, hours_later + FRAME_S, hours_later, steps=60)
    error = field.deltas(hours_later + FRAME_S).detach() - wave(5, hours_later + FRAME_S)
    assert float(error[:, :3].abs().max()) < 0.03


def test_ring_new_bumps_have_zero_moments():
    field = online(2)
    newest = 0.0
    for frame in range(100):
        watch(field, frame * FRAME_S, newest)
        newest = frame * FRAME_S
    while field.columns == (before := field.columns):
        newest += FRAME_S
        field.cover(newest, newest - FRAME_S)
        if field.columns != before:
            break
    moments = field._moments
    for tensor in (*moments.first, *moments.second, moments.steps):
        assert (field.columns.in_order(tensor)[:, -1] == 0).all()
        assert (field.columns.in_order(tensor)[:, -4] != 0).any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_ring_equals_full_field_for_random_frames_gaps_and_gaussians(seed):
    chance = random.Random(seed)
    ring, everything = exact(online(5)), exact(online(5, history_s=None))
    capacity = 24
    ring.reserve(capacity)
    ring.cover(0.0, 0.0), everything.cover(0.0, 0.0)
    at, newest = addresses(ring), 0.0
    for _ in range(70):
        action = chance.choice(["frame"] * 6 + ["gap", "add", "copy", "leave"])
        if action in ("frame", "gap"):
            time_s = newest + (chance.uniform(0.3, 1.5) if action == "gap" else FRAME_S)
            for field in (ring, everything):
                watch(field, time_s, newest)
            newest = time_s
        elif action == "add" and ring.count < capacity - 3:
            for field in (ring, everything):
                field.append(3)
        elif action == "copy" and 2 <= ring.count < capacity - 2:
            for field in (ring, everything):
                field.append(2, parents=torch.tensor([1, 0]))
        elif action == "leave" and ring.count > 3:
            removed = torch.tensor([chance.random() < 0.3 for _ in range(ring.count)])
            moves = RowMoves.without(removed)
            ring.close_gaps(moves)
            everything.select(moves.order)
        assert ring.count == everything.count
        for back_s in (0.0, 0.31, 0.9):
            time_s = max(newest - back_s, ring.time_window_s[0])
            torch.testing.assert_close(ring.deltas(time_s), everything.deltas(time_s), rtol=0, atol=1e-6)
    assert addresses(ring) == at
    used = ring.count
    for tensor in (ring.weights.data, *ring._moments.first, *ring._moments.second, ring._moments.steps):
        assert (tensor[used:] == 0).all()


def test_ring_reserved_rows_can_be_deformed_and_trained():
    field = online(4)
    field.reserve(9)
    watch(field, 0.1, 0.0)

    class Rows:
        count = 9

    at = field.frame_deltas(Rows())(torch.tensor([field.frame_time(0.1)]))
    assert torch.equal(at[:4, :13], field.deltas(0.1)) and (at[4:] == 0).all()
    gradient = torch.zeros(9, 16)
    gradient[:4] = 1.0
    expected = online(4)
    watch(expected, 0.1, 0.0)
    expected.adam_step(0.1, torch.ones(4, 13), RATES)
    field.adam_step_at(field.frame_time(0.1), gradient, list(vars(RATES).values()))
    assert torch.equal(field.deltas(0.1), expected.deltas(0.1))
    assert (field.weights[4:] == 0).all()


def test_ring_restart_equals_new_field_in_same_memory():
    field = online(3)
    field.reserve(8)
    newest = 0.0
    for frame in range(100):
        watch(field, frame * FRAME_S, newest)
        newest = frame * FRAME_S
    at = addresses(field)
    field.restart(50.0, 3)
    fresh = online(3)
    fresh.restart(50.0, 3)
    assert addresses(field) == at and field.config() == fresh.config()
    assert fresh.time_window_s == online(3, start_s=50.0).time_window_s
    for frame in range(80):
        for each in (field, fresh):
            watch(each, 50.0 + frame * FRAME_S, 50.0 + max(0, frame - 1) * FRAME_S)
    assert torch.equal(field.deltas(54.0), fresh.deltas(54.0))


def test_ring_restart_rejects_more_gaussians_than_rows():
    field = online(3)
    with pytest.raises(InvalidInput, match="a field with 3 rows cannot restart with 4 Gaussians"):
        field.restart(0.0, 4)


def test_saved_ring_contains_window(tmp_path, make_gaussians):
    gaussians = make_gaussians(5)
    field = online(5)
    field.reserve(11)
    newest = 0.0
    for frame in range(120):
        watch(field, frame * FRAME_S, newest)
        newest = frame * FRAME_S
    copied = field.detached_copy()
    assert tuple(copied.centers.shape) == (5, field.bumps)
    window = (field.time_window_s[0], newest)
    save_bundle(Model(1, gaussians, copied, Camera.from_focal(30.0, 32, 24), window), tmp_path / "model")
    loaded = load_bundle(tmp_path / "model").field
    for back_s in (0.0, 0.7, 1.9):
        wanted = field.deltas(newest - back_s).detach()
        torch.testing.assert_close(loaded.deltas(newest - back_s), wanted, rtol=0, atol=1e-6)
    loaded.extend((window[0], newest + 5.0), hold_at_s=newest)  # what it was loaded as keeps everything again
    torch.testing.assert_close(loaded.deltas(newest - 1.0), field.deltas(newest - 1.0).detach(), rtol=0, atol=1e-6)


def test_ring_snapshots_keep_addresses(make_gaussians, device):
    gaussians = make_gaussians(5).to(device)
    field = online(5).to(device)
    slots = SnapshotSlots(device, most=1, rows=40)
    newest, layouts = 0.0, set()
    for frame in range(120):
        watch(field, frame * FRAME_S, newest)
        newest = frame * FRAME_S
        snapshot = slots.publish(
            gaussians, field, version=1, camera=Camera.from_focal(30.0, 32, 24), time_window_s=field.time_window_s
        )
        layouts.add((snapshot.slot.layout, snapshot.slot.field.weights.data_ptr(), snapshot.slot.gaussians.count))
        assert torch.equal(snapshot.at(newest).means, field(gaussians, newest).means)
        saved = snapshot.as_model().field
        torch.testing.assert_close(saved.deltas(newest), field.deltas(newest).detach(), rtol=0, atol=1e-6)
        del snapshot
    assert len(layouts) == 1


@pytest.mark.parametrize("history_s", [0.0, -1.0, float("nan"), float("inf")])
def test_ring_rejects_invalid_history(history_s):
    with pytest.raises(InvalidInput, match="history_s"):
        online(1).keep_last(history_s)


def test_ring_held_motion_fades_for_trained_gaussians_only():
    field, newest = online(2), 0.0
    field.keep_last(HISTORY_S, fading_s=1.0)
    pull = torch.zeros(2, 13)
    for frame in range(60):
        field.cover(frame * FRAME_S, newest)
        newest = frame * FRAME_S
        field.adam_step(newest, field.deltas(newest).detach() - 0.2, RATES)
    before = field.deltas(newest).detach()
    for frame in range(60, 160):
        field.cover(frame * FRAME_S, newest)
        newest = frame * FRAME_S
        pull[0, 12] = 1e-15 if frame % 2 else -1e-15  # seen, and as it should be
        field.adam_step(newest, pull, BasisRates(0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    seen, hidden = field.deltas(newest).detach()
    assert float((seen / before[0])[:3].max()) < 0.4
    torch.testing.assert_close(hidden[:3], before[1, :3], rtol=0.1, atol=1e-3)
