"""Extrapolation of a field after the newest frame, and its displacement at one time."""

from __future__ import annotations

import math

import pytest
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.deformation.field import Continuation
from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import Gaussians


def moving_field(count: int = 5) -> BasisField:
    field = BasisField(count, (0.0, 1.0), bumps=8)
    torch.manual_seed(0)
    field.weights.data.normal_()
    return field


def some_gaussians(count: int = 5) -> Gaussians:
    return Gaussians(
        torch.zeros(count, 3), torch.eye(4)[:1].repeat(count, 1), torch.zeros(count, 3), torch.zeros(count),
        torch.zeros(count, 1, 3),
    )  # fmt: skip


def test_continuation_is_linear_after_newest_frame_then_constant() -> None:
    field = moving_field()
    before, newest = field.deltas(0.3).detach(), field.deltas(0.5).detach()
    field.continue_with(torch.full((5, 16), 2.0), 0.5, 0.1)
    assert torch.equal(field.deltas(0.3), before)
    assert torch.equal(field.deltas(0.5), newest)
    torch.testing.assert_close(field.deltas(0.55), newest + 0.1)
    torch.testing.assert_close(field.deltas(0.6), newest + 0.2)
    assert torch.equal(field.deltas(0.9), field.deltas(0.6))


def test_continuation_reaches_beyond_window_of_field() -> None:
    field = moving_field()
    newest = field.deltas(1.0).detach()
    field.continue_with(torch.full((5, 16), 2.0), 1.0, 0.1)
    torch.testing.assert_close(field.deltas(1.05), newest + 0.1)
    assert torch.equal(field.deltas(7.0), field.deltas(1.1))


@pytest.mark.parametrize("time_s", [0.2, 0.5, 0.53, 0.6, 3.0])
def test_continuation_equal_in_captured_frame(time_s: float) -> None:
    field = moving_field()
    field.continue_with(torch.randn(5, 16, generator=torch.Generator().manual_seed(1)), 0.5, 0.1)
    captured = field.frame_deltas(some_gaussians())(torch.tensor([field.frame_time(time_s)]))
    torch.testing.assert_close(captured[:, :13], field.deltas(time_s).detach(), rtol=1e-4, atol=1e-5)


def test_continuation_without_velocity_adds_nothing() -> None:
    field = moving_field()
    plain = [field.deltas(t).detach() for t in (0.1, 0.5)]
    field.continue_with(torch.zeros(0, 16), 0.5, 0.1)
    assert all(torch.equal(field.deltas(t), p) for t, p in zip((0.1, 0.5), plain, strict=True))
    assert torch.equal(field.deltas(0.6), field.deltas(0.5))


def test_continuation_is_copied_but_not_saved() -> None:
    field = moving_field()
    names = set(field.state_dict())
    field.continue_with(torch.ones(5, 16), 0.5, 0.1)
    assert set(field.state_dict()) == names
    assert torch.equal(field.detached_copy().deltas(0.6), field.deltas(0.6).detach())
    assert "continuation" not in str(field.config())


def test_continuation_slot_follows_start_and_stop() -> None:
    field = moving_field()
    field.continue_with(torch.ones(5, 16), 0.5, 0.1)
    slot = field.slot(8)
    assert slot is not None and slot.overwrite(field)
    torch.testing.assert_close(slot.exact_copy().deltas(0.6), field.deltas(0.6).detach())  # type: ignore[attr-defined]
    field.stop_continuing()
    assert slot.overwrite(field)
    torch.testing.assert_close(slot.exact_copy().deltas(0.6), field.deltas(0.6).detach())  # type: ignore[attr-defined]


def test_slot_without_continuation_cannot_be_overwritten() -> None:
    field = moving_field()
    slot = field.slot(8)
    assert slot is not None and slot.overwrite(field)
    field.continue_with(torch.ones(5, 16), 0.5, 0.1)
    assert not slot.overwrite(field)


def test_continuation_with_fewer_rows_clears_old_rows() -> None:
    continuation = Continuation(4)
    continuation.write(torch.ones(4, 16), 1.0, 0.5)
    continuation.write(torch.ones(2, 16), 1.0, 0.5)
    added = continuation.added(2.0, 4)
    assert added is not None
    assert added.sum(dim=1).tolist() == [8.0, 8.0, 0.0, 0.0]
    continuation.stop()
    assert continuation.added(2.0, 4) is None


@pytest.mark.parametrize(
    ("rows", "from_s", "horizon_s"), [(5, 0.0, 0.1), (2, math.nan, 0.1), (2, math.inf, 0.1), (2, 0.0, -1.0)]
)
def test_continuation_rejects_invalid_arguments(rows: int, from_s: float, horizon_s: float) -> None:
    with pytest.raises(InvalidInput):
        Continuation(4).write(torch.ones(rows, 16), from_s, horizon_s)


def test_move_to_changes_field_at_given_time_only() -> None:
    field = moving_field()
    before, far = field.deltas(0.5).detach(), field.deltas(0.0).detach()
    change = torch.randn(5, 13, generator=torch.Generator().manual_seed(2))
    change[3] = math.nan
    field.move_to(0.5, before + change)
    expected = before + change
    expected[3] = before[3]
    torch.testing.assert_close(field.deltas(0.5).detach(), expected)
    assert (field.deltas(0.0).detach() - far).abs().max() < 0.2 * change[:3].abs().max()


def test_move_to_at_equals_move_to_and_ignores_further_columns() -> None:
    field, expected = moving_field(), moving_field()
    tau = torch.tensor([field.frame_time(0.5)])
    wanted = field.frame_deltas(some_gaussians())(tau) + 0.25
    field.move_to_at(tau, wanted)
    expected.move_to(0.5, wanted[:, :13])
    assert torch.equal(field.weights, expected.weights)
    torch.testing.assert_close(field.deltas(0.5).detach(), wanted[:, :13])


def test_scale_positions_applies_at_all_times() -> None:
    field = moving_field()
    before = field.deltas(0.4).detach()
    factor = torch.tensor([1.0, 2.0, 0.5, 40.0, 1.0])
    field.scale_positions(factor)
    torch.testing.assert_close(field.deltas(0.4).detach()[:, :3], before[:, :3] * factor[:, None])
    assert torch.equal(field.deltas(0.4).detach()[:, 3:], before[:, 3:])
