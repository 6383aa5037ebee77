"""Properties that both deformation fields share."""

import json

import pytest
import torch

from gsplat_core.deformation import FIELDS, BasisField, HexPlaneField, field_from_config, kind_of, new_field
from gsplat_core.errors import InvalidInput, InvalidSetting

WINDOW = (1.0, 6.0)
BOTH = pytest.mark.parametrize("kind", ["basis", "hexplane"])


def disturbed(kind, gaussians, window=WINDOW):
    torch.manual_seed(0)
    field = new_field(kind, gaussians, window)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return field


def largest_difference(a, b):
    pairs = zip(a.tensors().values(), b.tensors().values(), strict=True)
    return max((float((x - y).detach().abs().max()) if x.numel() else 0.0) for x, y in pairs)


@BOTH
@pytest.mark.parametrize("count", [0, 1, 200])
def test_untrained_field_is_identity(kind, count, make_gaussians):
    gaussians = make_gaussians(count, sh_degree=1)
    field = new_field(kind, gaussians, WINDOW)
    for time_s in (-5.0, 1.0, 3.3, 6.0, 99.0):
        assert largest_difference(field(gaussians, time_s), gaussians) == 0.0
        assert largest_difference(field.cached(gaussians)(time_s), gaussians) == 0.0


@BOTH
@pytest.mark.parametrize("count", [0, 1, 777])
def test_cached_field_equals_plain_field(kind, count, make_gaussians):
    gaussians = make_gaussians(count, sh_degree=1)
    field = disturbed(kind, gaussians)
    at = field.cached(gaussians)
    for time_s in (-5.0, 1.0, 1.01, 3.3, 5.99, 6.0, 99.0):
        plain = field(gaussians, time_s)
        assert largest_difference(at(time_s), plain) <= 1e-5
        assert count == 0 or largest_difference(plain, gaussians) > 1e-3
        assert not at(time_s).means.requires_grad


@BOTH
def test_field_outside_window_equals_nearest_end(kind, make_gaussians):
    gaussians = make_gaussians(50)
    field = disturbed(kind, gaussians)
    assert largest_difference(field(gaussians, 0.0), field(gaussians, WINDOW[0])) == 0.0
    assert largest_difference(field(gaussians, 1e9), field(gaussians, WINDOW[1])) == 0.0


@BOTH
def test_field_rejects_nan_time(kind, make_gaussians):
    gaussians = make_gaussians(2)
    field = new_field(kind, gaussians, WINDOW)
    with pytest.raises(InvalidInput, match="nan"):
        field(gaussians, float("nan"))


@BOTH
def test_field_config_rebuilds_architecture(kind, make_gaussians):
    gaussians = make_gaussians(30)
    field = disturbed(kind, gaussians)
    config = json.loads(json.dumps(field.config()))
    rebuilt = field_from_config(config, gaussians)
    rebuilt.load_state_dict(field.state_dict())
    assert rebuilt.config() == field.config()
    assert largest_difference(rebuilt(gaussians, 2.7), field(gaussians, 2.7)) == 0.0


@BOTH
def test_field_gradients_reach_parameters_and_gaussians(kind, make_gaussians):
    gaussians = make_gaussians(40).requires_grad_()
    field = disturbed(kind, gaussians)
    field(gaussians, 3.0).means.square().sum().backward()
    assert gaussians.means.grad.abs().sum() > 0
    assert all(p.grad is not None and p.grad.isfinite().all() for p in field.parameters())
    assert sum(float(p.grad.abs().sum()) for p in field.parameters()) > 0


@BOTH
def test_field_float64_uses_reference(kind, make_gaussians):
    gaussians = make_gaussians(20)
    field = disturbed(kind, gaussians)
    exact = field.detached_copy().to(torch.float64)
    difference = largest_difference(exact(gaussians.to(dtype=torch.float64), 2.5), field(gaussians, 2.5))
    assert difference < 1e-4


@BOTH
def test_field_detached_copy_unchanged_by_training(kind, make_gaussians):
    gaussians = make_gaussians(20)
    field = disturbed(kind, gaussians)
    copied = field.detached_copy()
    before = copied(gaussians, 2.0)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter += 1.0
    assert largest_difference(copied(gaussians, 2.0), before) == 0.0
    assert not any(p.requires_grad for p in copied.parameters())


def test_new_field_selects_kind(make_gaussians):
    gaussians = make_gaussians(3)
    assert isinstance(new_field("auto", gaussians, WINDOW), BasisField)
    assert isinstance(new_field("basis", gaussians, WINDOW, bumps=9), BasisField)
    assert isinstance(new_field("hexplane", gaussians, WINDOW, channels=8), HexPlaneField)
    assert list(FIELDS) == ["auto", "basis", "hexplane"]
    with pytest.raises(InvalidSetting, match="'spline'; known are auto, basis, hexplane"):
        new_field("spline", gaussians, WINDOW)


@pytest.mark.parametrize("kind", ["spline", "auto", None, 3, ["basis"], "b" * 10_000])
def test_field_from_config_rejects_unknown_kind(kind, make_gaussians):
    with pytest.raises(InvalidSetting, match="known are basis, hexplane") as refused:
        field_from_config({"kind": kind}, make_gaussians(3))
    assert len(str(refused.value)) < 200


@BOTH
def test_field_checked_config_rejects_values_out_of_range(kind, make_gaussians):
    config = new_field(kind, make_gaussians(2), WINDOW).config()
    for name in config.keys() - {"kind"}:
        below = [] if name == "origin_s" else [-1, 0]
        for wrong in (*below, None, True, 10**400, float("nan"), float("inf"), "4", [], [1] * 100, {}, [[2]] * 4):
            with pytest.raises((InvalidInput, InvalidSetting), match=name):
                kind_of(kind).checked_config(config | {name: wrong})
    assert kind_of(kind).checked_config(config | {"more": 1}).keys() == config.keys()


@pytest.mark.parametrize("window", [(2.0, 1.0), (0.0, float("inf")), (float("nan"), 1.0)])
def test_field_rejects_invalid_window(window, make_gaussians):
    for kind in ("basis", "hexplane"):
        with pytest.raises(InvalidInput, match="time_window_s"):
            new_field(kind, make_gaussians(1), window)


@BOTH
def test_field_accepts_window_of_zero_length(kind, make_gaussians):
    gaussians = make_gaussians(10)
    field = disturbed(kind, gaussians, (2.0, 2.0))
    assert largest_difference(field(gaussians, 2.0), field(gaussians, 5.0)) == 0.0
    assert field(gaussians, 2.0).means.isfinite().all()
