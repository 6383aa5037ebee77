"""The basis field: bumps in time, an endless stream, and its own lazy Adam."""

import pytest
import torch

from gsplat_core.deformation import BasisField, BasisRates
from gsplat_core.deformation.field import displaced
from gsplat_core.errors import InvalidInput

RATES = BasisRates()


def random_field(count, window=(0.0, 4.0), **layout):
    torch.manual_seed(1)
    field = BasisField(count, window, **layout)
    with torch.no_grad():
        field.weights.normal_()
        field.centers += 0.2 * torch.randn_like(field.centers)
        field.log_widths += 0.1 * torch.randn_like(field.log_widths)
    return field


def test_basis_field_bumps_cover_window_and_one_spacing():
    field = BasisField(3, (10.0, 15.0), bumps=13)
    assert field.spacing_s == 0.5
    assert field.frame_time(10.0) == pytest.approx(1.0)
    assert field.frame_time(15.0) == pytest.approx(11.0)
    assert torch.equal(field.centers[0], torch.arange(13.0))
    assert torch.equal(field.log_widths, torch.zeros(3, 13))
    by_spacing = BasisField(3, (10.0, 15.0), spacing_s=0.5)
    assert by_spacing.config() == field.config()


def test_basis_field_equal_weights_give_constant_motion():
    field = BasisField(1, (0.0, 4.0), bumps=16)
    with torch.no_grad():
        field.weights[:] = 1.0
    values = torch.stack([field.deltas(t / 50)[0, 0] for t in range(60, 141)])  # away from the ends
    assert float(values.detach().max() / values.detach().min()) < 1.001


def test_displaced_applies_channels_to_matching_parameters(make_gaussians):
    gaussians = make_gaussians(2, sh_degree=1)
    deltas = torch.zeros(2, 13)
    deltas[:, :3], deltas[:, 3:7], deltas[:, 7:10], deltas[:, 10:] = 1.0, 2.0, 3.0, 4.0
    moved = displaced(gaussians, deltas)
    assert torch.equal(moved.means, gaussians.means + 1)
    assert torch.equal(moved.quats, gaussians.quats + 2)
    assert torch.equal(moved.log_scales, gaussians.log_scales + 3)
    assert torch.equal(moved.sh[:, 0], gaussians.sh[:, 0] + 4)
    assert torch.equal(moved.sh[:, 1:], gaussians.sh[:, 1:])
    assert torch.equal(moved.logit_opacities, gaussians.logit_opacities)


def test_basis_field_extend_keeps_existing_motion():
    field = random_field(20)
    times = [0.0, 0.7, 2.0, 3.1]
    before = [field.deltas(t).detach() for t in times]
    columns = field.bumps
    field.extend((0.0, 9.0))
    assert field.bumps > columns and field.time_window_s == (0.0, 9.0)
    assert (field.bumps - 1) * field.spacing_s + field.columns.origin_s >= 9.0 + field.spacing_s - 1e-6
    for t, wanted in zip(times, before, strict=True):
        torch.testing.assert_close(field.deltas(t).detach(), wanted, rtol=0, atol=0)


def test_basis_field_trimming_keeps_motion_of_new_window():
    field = BasisField(20, (0.0, 4.0), bumps=30)
    with torch.no_grad():
        field.weights.normal_(generator=torch.Generator().manual_seed(0))
    before = [field.deltas(t).detach() for t in (3.0, 3.5, 4.0)]
    field.extend((3.0, 4.0))
    assert field.bumps < 30
    for t, wanted in zip((3.0, 3.5, 4.0), before, strict=True):
        torch.testing.assert_close(field.deltas(t).detach(), wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_basis_field_size_and_precision_constant_in_long_stream():
    field = BasisField(5, (0.0, 2.0), spacing_s=0.2)
    sizes = set()
    for second in range(1, 4000):
        field.extend((float(second), float(second) + 2.0))
        sizes.add(field.bumps)
    assert max(sizes) <= 2.0 / 0.2 + 3 + 6
    # Columns are still where they were laid out, to the last bit that float32 has at the column's number.
    assert torch.equal(field.centers[0], torch.arange(float(field.bumps)))
    assert 0 <= field.frame_time(3999.0) <= 8


def test_basis_field_new_bumps_hold_last_motion_on_request():
    held, still = random_field(10), random_field(10)
    with torch.no_grad():
        for field in (held, still):
            field.weights[:] = 1.0
            field.centers[:] = torch.arange(float(field.bumps))
            field.log_widths[:] = 0.0
    held.extend((0.0, 8.0), hold_at_s=2.0)
    still.extend((0.0, 8.0))
    middle = held.deltas(2.0).detach()
    torch.testing.assert_close(held.deltas(7.0).detach(), middle, rtol=1e-3, atol=1e-3)
    assert float(still.deltas(7.0).detach().abs().max()) == 0.0


def test_basis_field_rejects_window_moving_backwards():
    field = BasisField(1, (1.0, 2.0))
    for window in ((0.5, 2.0), (1.0, 1.5)):
        with pytest.raises(InvalidInput, match="forward"):
            field.extend(window)


def test_basis_field_adam_step_lowers_loss_after_structural_changes():
    field = BasisField(30, (0.0, 2.0), spacing_s=0.25)
    target = torch.randn(30, 13, generator=torch.Generator().manual_seed(5)) * 0.05

    def loss_after(steps, time_s):
        for _ in range(steps):
            field.adam_step(time_s, field.deltas(time_s).detach() - target, RATES)
        return float((field.deltas(time_s).detach() - target).square().sum())

    start = float(target.square().sum())
    assert loss_after(40, 1.0) < 0.2 * start
    field.extend((0.0, 5.0))
    field.append(10)
    target = torch.cat([target, 0.05 * torch.ones(10, 13)])
    assert loss_after(40, 4.5) < 0.2 * float(target.square().sum())
    keep = torch.arange(0, 40, 2)
    field.select(keep)
    target = target[keep]
    assert loss_after(1, 4.5) <= 0.2 * float(target.square().sum())
    assert field.count == 20


def test_basis_field_late_bump_starts_with_learning_rate_steps():
    field = BasisField(1, (0.0, 1.0), spacing_s=0.25)
    for _ in range(200):
        field.adam_step(0.5, torch.ones(1, 13), RATES)
    field.extend((0.0, 9.0))
    for _ in range(5):
        before = field.weights.detach().clone()
        field.adam_step(9.0, torch.ones(1, 13), RATES)
        step = (field.weights.detach() - before)[..., 0].abs().max()
        assert float(step) == pytest.approx(RATES.position, rel=1e-2)


def test_basis_field_appended_gaussians_start_still_or_like_parents():
    field = random_field(4)
    field.adam_step(1.0, torch.ones(4, 13), RATES)
    field.append(2)
    field.append(2, parents=torch.tensor([1, 3]))
    deltas = field.deltas(1.0).detach()
    assert deltas.shape == (8, 13)
    assert (deltas[4:6] == 0).all()
    assert torch.equal(deltas[6:], deltas[[1, 3]])
    with pytest.raises(InvalidInput, match=r"\[3\]"):
        field.append(3, parents=torch.tensor([0]))


def test_many_small_additions_allocate_rarely():
    field = BasisField(1000, (0.0, 1.0), bumps=6)
    allocated = set()
    for _ in range(400):
        field.append(10)
        allocated.add(field.weights.shape[0])
    assert field.count == 5000 and max(allocated) <= 1.25 * 5000
    assert len(allocated) < 10


def test_basis_field_select_accepts_indices_or_mask():
    field = random_field(5)
    before = field.deltas(1.0).detach()
    field.select(torch.tensor([True, False, True, True, False]))
    assert torch.equal(field.deltas(1.0).detach(), before[[0, 2, 3]])
    field.select(torch.tensor([2, 0]))
    assert torch.equal(field.deltas(1.0).detach(), before[[3, 0]])


def test_basis_field_rejects_different_gaussian_count(make_gaussians):
    with pytest.raises(InvalidInput, match="5 Gaussians, got 4"):
        BasisField(5, (0.0, 1.0))(make_gaussians(4), 0.5)


@pytest.mark.parametrize("layout", [{"bumps": 3}, {"spacing_s": 0.0}, {"spacing_s": float("nan")}])
def test_basis_field_rejects_invalid_layouts(layout):
    with pytest.raises(InvalidInput):
        BasisField(1, (0.0, 1.0), **layout)


def test_basis_field_nan_affects_own_gaussian_only(make_gaussians):
    gaussians = make_gaussians(6)
    field = random_field(6)
    with torch.no_grad():
        field.weights[2] = float("nan")
    moved = field(gaussians, 1.0)
    assert moved.means[2].isnan().all()
    assert moved.means[[0, 1, 3, 4, 5]].isfinite().all()


def test_basis_field_spare_columns_become_bumps_without_reallocation(device):
    def grown(spare: bool) -> BasisField:
        torch.manual_seed(3)
        field = BasisField(7, (0.0, 1.0), bumps=6).to(device)
        if spare:
            field._add_places(9)
        for step in range(4):
            torch.manual_seed(step)
            for parameter in field.parameters():
                parameter.data[:, : field.bumps] += 0.1 * torch.randn(parameter[:, : field.bumps].shape).to(device)
            field.adam_step(0.2 * step, torch.ones(field.count, 13, device=device), BasisRates())
            field.extend((0.0, 1.5 + 0.5 * step), hold_at_s=0.9)
            field.append(2)
        return field

    exact, spared = grown(False), grown(True)
    assert spared.bumps == exact.bumps and spared.config() == exact.config()
    for time_s in (0.0, 0.7, 2.2, 3.0):
        assert torch.equal(spared.deltas(time_s), exact.deltas(time_s))
    published, expected = spared.detached_copy().state_dict(), exact.detached_copy().state_dict()
    assert {name: tensor.shape for name, tensor in published.items()} == {n: t.shape for n, t in expected.items()}
    assert all(torch.equal(tensor, expected[name]) for name, tensor in published.items())
    before = spared.weights.data_ptr()
    spared._add_places(3)
    at = spared.weights.data_ptr()
    spared.extend((0.0, 3.3), hold_at_s=3.0)
    assert at != before and spared.weights.data_ptr() == at
