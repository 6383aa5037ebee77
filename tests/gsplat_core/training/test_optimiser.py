"""FusedAdam: torch's Adam over named tensors, whose rows come and go."""

import pytest
import torch

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import RowMoves
from gsplat_core.training.steps.optimiser import FusedAdam

RATES = {"means": 0.01, "sh": 0.002, "logit_opacities": 0.05}


def tensors(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(count, *shape, generator=generator)
    return {"means": draw(3), "sh": draw(4, 3), "logit_opacities": draw()}


def test_fused_adam_equals_torch_adam_with_changing_rates():
    ours = {name: tensor.requires_grad_() for name, tensor in tensors(50).items()}
    theirs = {name: tensor.detach().clone().requires_grad_() for name, tensor in ours.items()}
    optimiser = FusedAdam(ours, RATES)
    expected = torch.optim.Adam([{"params": [theirs[name]], "lr": rate} for name, rate in RATES.items()], eps=1e-8)
    for step in range(6):
        gradients = tensors(50, seed=10 + step)
        for name in RATES:
            ours[name].grad, theirs[name].grad = gradients[name], gradients[name].clone()
        rate = 0.01 / (step + 1)
        expected.param_groups[0]["lr"] = rate
        assert optimiser.step(ours, learning_rates={"means": rate}) == 0
        expected.step()
        for name in RATES:
            torch.testing.assert_close(ours[name], theirs[name], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("index", [torch.tensor([7, 2, 2, 0]), torch.arange(10) % 3 == 0])
def test_fused_adam_select_keeps_moments_of_rows(index):
    whole, gradients = tensors(10), tensors(10, seed=1)
    optimiser = FusedAdam(whole, RATES)
    optimiser.step(whole, gradients)
    part = {name: tensor[index].clone() for name, tensor in whole.items()}
    optimiser.step(whole, gradients)

    other = tensors(10)
    selecting = FusedAdam(other, RATES)
    selecting.step(other, gradients)
    selecting.select(index)
    assert selecting.count == len(part["means"])
    selecting.step(part, {name: gradient[index] for name, gradient in gradients.items()})
    for name in RATES:
        assert torch.equal(part[name], whole[name][index])


def test_fused_adam_append_adds_rows_without_moments():
    whole, gradients = tensors(6), tensors(6, seed=1)
    optimiser = FusedAdam(whole, RATES)
    optimiser.step(whole, gradients)
    before = {name: moment.clone() for name, moment in optimiser.first_moments.items()}
    optimiser.append(2)
    assert optimiser.count == 8
    for name in RATES:
        assert torch.equal(optimiser.first_moments[name][:6], before[name])
        assert not optimiser.second_moments[name][6:].any()
    with pytest.raises(InvalidInput, match="select or append"):
        optimiser.step(whole, gradients)


def test_fused_adam_append_usual_limits_first_steps():
    """Rows that join after many steps share a bias correction that is over."""
    moved = {}
    for usual in (False, True):
        whole, gradients = tensors(6), tensors(6, seed=1)
        optimiser = FusedAdam(whole, RATES)
        for _ in range(2000):
            optimiser.step(whole, gradients)
        joined = {name: torch.cat([tensor, tensor[:2]]) for name, tensor in whole.items()}
        more = {name: torch.cat([gradient, gradient[:2]]) for name, gradient in gradients.items()}
        optimiser.append(2, usual=usual)
        longest = 0.0
        for _ in range(30):
            before = joined["sh"].clone()
            optimiser.step(joined, more)
            longest = max(longest, float((joined["sh"] - before)[6:].abs().max()) / RATES["sh"])
        moved[usual] = longest
    assert moved[False] > 5
    assert moved[True] < moved[False] / 2


def test_fused_adam_skips_and_counts_non_finite_rows():
    values, gradients = tensors(6), tensors(6, seed=1)
    before = {name: tensor.clone() for name, tensor in values.items()}
    gradients["means"][1, 2] = torch.nan
    gradients["sh"][1, 0, 0] = gradients["sh"][4, 3, 2] = torch.inf
    optimiser = FusedAdam(values)
    assert optimiser.step(values, gradients, RATES) == 3
    assert optimiser.skipped == 3
    assert torch.equal(values["means"][1], before["means"][1])
    assert torch.equal(values["sh"][[1, 4]], before["sh"][[1, 4]])
    assert (values["logit_opacities"] != before["logit_opacities"]).all()
    assert all(torch.isfinite(moment).all() for moment in optimiser.second_moments.values())


def test_fused_adam_keeps_tensor_without_gradient():
    values = tensors(3)
    before = values["sh"].clone()
    FusedAdam(values, RATES).step(values, {"means": torch.ones(3, 3), "sh": None})
    assert torch.equal(values["sh"], before)


def test_fused_adam_reset_clears_moments_of_rows():
    values = tensors(4)
    optimiser = FusedAdam(values, RATES)
    optimiser.step(values, tensors(4, seed=1))
    optimiser.reset("sh", torch.tensor([2]))
    assert not optimiser.first_moments["sh"][2].any()
    assert optimiser.first_moments["sh"][3].any()
    optimiser.reset("sh")
    assert not optimiser.second_moments["sh"].any()


def test_fused_adam_dense_tensors_skip_single_elements():
    plane = {"plane": torch.zeros(2, 5)}
    optimiser = FusedAdam(plane, {"plane": 0.1}, rows=False)
    gradient = torch.ones(2, 5)
    gradient[0, 3] = torch.nan
    assert optimiser.step(plane, {"plane": gradient}) == 1
    assert (plane["plane"] == 0).sum() == 1
    changes = (
        lambda: optimiser.append(1),
        lambda: optimiser.select(torch.tensor([0])),
        lambda: optimiser.close_gaps(RowMoves.without(torch.tensor([True, False]))),
        lambda: optimiser.restart(1),
        lambda: optimiser.count,
    )
    for change in changes:
        with pytest.raises(InvalidInput, match="rows=False"):
            change()
    assert optimiser.first_moments["plane"].shape == (2, 5)


def test_fused_adam_of_empty_tensors():
    values = tensors(0)
    optimiser = FusedAdam(values, RATES)
    assert optimiser.step(values, tensors(0)) == 0
    optimiser.append(3)
    assert optimiser.count == 3


def test_fused_adam_refuses_mismatched_names_and_rows():
    values = tensors(4)
    with pytest.raises(InvalidInput, match="must match"):
        FusedAdam(values, {"means": 0.1})
    with pytest.raises(InvalidInput, match="must match"):
        FusedAdam(values).step(values, tensors(4), {"means": 0.1})
    with pytest.raises(InvalidInput, match="one row per Gaussian"):
        FusedAdam({"a": torch.zeros(2), "b": torch.zeros(3)}, {"a": 1.0, "b": 1.0})
    with pytest.raises(InvalidInput, match="sh"):
        FusedAdam(values, RATES).step({"means": values["means"]}, {})


@pytest.mark.parametrize(
    ("shape", "kept"), [((5, 3), 5), ((8, 3), 5), ((4, 3), 0), ((5, 4), 0), ((8, 4), 0), ((5, 3, 2), 0)]
)
def test_fused_adam_follow_keeps_moments_if_rows_were_added(shape, kept):
    optimiser = FusedAdam({"a": torch.zeros(5, 3), "b": torch.zeros(2)}, rows=False)
    for moments in (optimiser.first_moments, optimiser.second_moments):
        for moment in moments.values():
            moment.fill_(7.0)
    before = optimiser.first_moments["b"]
    optimiser.follow({"a": torch.zeros(shape), "b": torch.ones(2)})
    for moments in (optimiser.first_moments, optimiser.second_moments):
        assert moments["a"].shape == shape and (moments["a"][:kept] == 7).all() and not moments["a"][kept:].any()
    assert optimiser.first_moments["b"] is before and (before == 7).all()
