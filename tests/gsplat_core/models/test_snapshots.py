"""`SnapshotSlots`: published states are exact, not overwritten while held, and keep their addresses while the scene grows."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from gsplat_core import Camera, InvalidInput, Model, render
from gsplat_core.deformation import BasisField, DeformationField, new_field
from gsplat_core.models import ROW_STEP, SnapshotSlots

CAMERA = Camera.from_focal(40.0, 32, 24)
WINDOW_S = (0.0, 1.0)
KINDS = pytest.mark.parametrize("kind", ["basis", "hexplane", None])


def field_for(gaussians, kind, seed=0):
    if kind is None:
        return None
    torch.manual_seed(seed)
    field = new_field(kind, gaussians, WINDOW_S).to(gaussians.device)
    stir(field, seed)
    return field


def stir(field, seed):
    generator = torch.Generator().manual_seed(seed)
    for parameter in field.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator).to(parameter.device)


def publish(slots, gaussians, field, version=1):
    return slots.publish(gaussians, field, version=version, camera=CAMERA, time_window_s=WINDOW_S)


def addresses(snapshot):
    tensors = [*snapshot.slot.gaussians.tensors().values()]
    if snapshot.slot.field is not None:
        tensors += [*snapshot.slot.field.parameters()]
    return [tensor.data_ptr() for tensor in tensors]


def model_of(gaussians, field):
    return Model(1, gaussians.clone(), None if field is None else field.detached_copy(), CAMERA, WINDOW_S)


@KINDS
def test_snapshot_equals_model_at_publication(kind, make_gaussians, device):
    gaussians = make_gaussians(40).to(device)
    field = field_for(gaussians, kind)
    expected = model_of(gaussians, field)
    snapshot = publish(SnapshotSlots(device), gaussians, field)
    # What is learned next does not reach what was published.
    gaussians.means.add_(5)
    if field is not None:
        stir(field, 1)
    assert snapshot.as_model().sha256() == expected.sha256()
    assert snapshot.parameter_count == expected.parameter_count
    assert snapshot.gaussian_count == 40
    for name, tensor in snapshot.at(0.4).tensors().items():
        torch.testing.assert_close(tensor, expected.at(0.4).tensors()[name], rtol=1e-5, atol=1e-5)


def test_snapshot_deformation_equals_model(make_gaussians, device):
    gaussians = make_gaussians(40).to(device)
    field = field_for(gaussians, "basis")
    snapshot = publish(SnapshotSlots(device), gaussians, field)
    for time_s in (-3.0, 0.0, 0.37, 1.0, 8.0):
        expected = model_of(gaussians, field).at(time_s).tensors()
        for name, tensor in snapshot.at(time_s).tensors().items():
            assert torch.equal(tensor, expected[name]), (time_s, name)


def test_snapshot_slot_holds_right_eye_colours(make_gaussians, device):
    slots, left = SnapshotSlots(device), make_gaussians(40).to(device)
    both = dataclasses.replace(left, right_sh=torch.randn_like(left.sh))
    layout = publish(slots, left, None).slot.layout
    for version, scene in ((2, both), (3, left)):
        snapshot = publish(slots, scene, None, version=version)
        layout += 1
        assert snapshot.slot.layout == layout, "memory with and without them is not the same"
        assert snapshot.as_model().sha256() == model_of(scene, None).sha256()
        del snapshot


def test_snapshot_spare_rows_are_invisible(make_gaussians, device):
    gaussians = make_gaussians(40).to(device)
    field = field_for(gaussians, "basis")
    snapshot = publish(SnapshotSlots(device), gaussians, field)
    everything = snapshot.slot.gaussians
    assert everything.count >= 50 and everything.count % ROW_STEP == 0
    assert (everything.logit_opacities[40:] == -math.inf).all() and not everything.opacities[40:].any()
    with torch.no_grad():
        shown = render(snapshot.slot.field(everything, 0.4), CAMERA)
        expected = render(field(gaussians, 0.4), CAMERA)
    assert torch.equal(shown.image, expected.image) and torch.equal(shown.depth, expected.depth)


def test_snapshot_growth_within_capacity_keeps_addresses(make_gaussians, device):
    gaussians = make_gaussians(40).to(device)
    field = BasisField(40, WINDOW_S, bumps=6).to(device)
    slots = SnapshotSlots(device)
    first = publish(slots, gaussians, field)
    before, layout = addresses(first), first.slot.layout
    del first
    field.extend((0.0, 2.0), hold_at_s=1.0)
    more = make_gaussians(30, seed=1).to(device)
    field.append(more.count)
    stir(field, 2)
    gaussians = gaussians.append(more)
    second = publish(slots, gaussians, field, version=2)
    assert addresses(second) == before and second.slot.layout == layout and slots.count == 1
    assert second.as_model().sha256() == model_of(gaussians, field).sha256()


def test_snapshot_of_smaller_scene_clears_old_rows(make_gaussians, device):
    slots = SnapshotSlots(device)
    large = make_gaussians(50).to(device)
    publish(slots, large, field_for(large, "basis"))
    small = make_gaussians(20, seed=1).to(device)
    field = BasisField(20, WINDOW_S, bumps=5).to(device)
    stir(field, 4)
    snapshot = publish(slots, small, field, version=2)
    assert slots.count == 1
    assert snapshot.as_model().sha256() == model_of(small, field).sha256()
    everything = snapshot.slot.field(snapshot.slot.gaussians, 0.5)
    assert (everything.logit_opacities[20:] == -math.inf).all()
    assert torch.equal(snapshot.slot.field.deltas(0.5)[:20], field.deltas(0.5))


@pytest.mark.parametrize(("rows", "bumps"), [(5000, 6), (40, 90)])
def test_snapshot_growth_beyond_capacity_changes_layout(make_gaussians, device, rows, bumps):
    slots = SnapshotSlots(device)
    gaussians = make_gaussians(40).to(device)
    layout = publish(slots, gaussians, BasisField(40, WINDOW_S, bumps=6).to(device)).slot.layout
    gaussians = make_gaussians(rows, seed=2).to(device)
    field = BasisField(rows, WINDOW_S, bumps=bumps).to(device)
    stir(field, 5)
    snapshot = publish(slots, gaussians, field, version=2)
    assert snapshot.slot.layout == layout + 1
    assert snapshot.as_model().sha256() == model_of(gaussians, field).sha256()


def test_held_snapshot_is_not_overwritten(make_gaussians):
    slots = SnapshotSlots("cpu", most=3)
    held = [publish(slots, make_gaussians(30, seed=k), None, version=k + 1) for k in range(3)]
    for k, snapshot in enumerate(held):
        assert torch.equal(snapshot.at(0.0).means, make_gaussians(30, seed=k).means)
    with pytest.raises(InvalidInput, match="all 3 snapshots"):
        publish(slots, make_gaussians(30), None, version=4)
    held.pop(1)
    assert publish(slots, make_gaussians(30, seed=9), None, version=4).slot.number == 1
    assert torch.equal(held[0].at(0.0).means, make_gaussians(30, seed=0).means)


def test_snapshot_copy_unaffected_by_slot_reuse(make_gaussians):
    slots = SnapshotSlots("cpu", most=1)
    gaussians = make_gaussians(30)
    model = publish(slots, gaussians, field_for(gaussians, "basis")).as_model()
    digest = model.sha256()
    publish(slots, make_gaussians(30, seed=1), None, version=2)
    assert model.sha256() == digest and slots.count == 1


def test_snapshot_of_other_scene_kind_replaces_tensors(make_gaussians):
    slots = SnapshotSlots("cpu", most=1)
    for number, (degree, kind) in enumerate([(0, None), (2, None), (2, "basis"), (2, "hexplane"), (0, None)]):
        gaussians = make_gaussians(30, sh_degree=degree)
        field = field_for(gaussians, kind)
        snapshot = publish(slots, gaussians, field, version=number + 1)
        assert snapshot.slot.layout == number + 1
        assert snapshot.as_model().sha256() == model_of(gaussians, field).sha256()
        del snapshot


def test_empty_scene_can_be_published(make_gaussians):
    empty = make_gaussians(3).select(slice(0, 0))
    snapshot = publish(SnapshotSlots("cpu"), empty, BasisField(0, WINDOW_S))
    assert snapshot.gaussian_count == 0 and snapshot.at(0.5).count == 0


def test_snapshot_rejects_field_without_slot_support(make_gaussians):
    class Still(DeformationField):
        def forward(self, gaussians, time_s):
            return gaussians

    with pytest.raises(InvalidInput, match="a Still cannot lie in a slot"):
        publish(SnapshotSlots("cpu"), make_gaussians(3), Still(WINDOW_S))
