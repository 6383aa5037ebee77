"""Densification: whose share of picture and error is whose, what is split, what is dropped, and that both halves move as one."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from gsplat_core.deformation import BasisField
from gsplat_core.errors import InvalidSetting
from gsplat_core.rendering.rasterization import render
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.step import TrainingStep, halves
from gsplat_core.training.strategies.mcmc import birth_death, relocated
from gsplat_core.training.strategies.streaming import UNSEEN_PX, Shares, densify, shares_of


@pytest.fixture(params=[False, True], ids=["exact", "preallocated"])
def step(make_frame, camera, request):
    gaussians = gaussians_from_frame(make_frame(), camera, 120, sh_degree=0, default_depth_mm=60.0)
    config = ReconstructorConfig(
        field="basis", gaussians=120, max_gaussians=300, squared_error=True, preallocate=request.param
    )
    return TrainingStep(gaussians, BasisField(gaussians.count, (0.0, 1.0), bumps=6), config, camera)


def test_shares_sum_to_picture_coverage_and_error(step, make_frame, camera):
    mask = np.ones((camera.height_px, camera.width_px), np.uint8)
    mask[:, :13] = 0
    seen = Observation.of(make_frame(2, shift_px=1, mask=mask), camera)
    shares = shares_of(step, [seen])
    image, alpha, _ = render(step.at(seen.time_s), camera)
    tissue = seen.mask > 0
    off = (image - seen.image / 255).abs().mean(-1)
    assert shares.seen_px.sum().item() == pytest.approx(alpha[tissue].sum().item(), rel=1e-4)
    assert shares.error.sum().item() == pytest.approx((alpha * off)[tissue].sum().item(), rel=1e-4)


def test_shares_of_several_pictures_sum_errors_and_take_best_view(step, make_frame, camera):
    one, other = (Observation.of(make_frame(seq, shift_px=seq), camera) for seq in (0, 3))
    both, first, second = shares_of(step, [one, other]), shares_of(step, [one]), shares_of(step, [other])
    torch.testing.assert_close(both.error, first.error + second.error)
    torch.testing.assert_close(both.seen_px, torch.maximum(first.seen_px, second.seen_px))


def test_shares_count_dark_tissue_like_bright_tissue(step, make_frame, camera):
    seen = Observation.of(make_frame(), camera)
    expected = shares_of(step, [seen]).seen_px
    step.gaussians.sh.fill_(-10.0)  # below black: the picture's gradient is zero there
    torch.testing.assert_close(shares_of(step, [seen]).seen_px, expected)


def test_densify_removes_unseen_and_splits_largest_errors(step, make_frame, camera):
    count = step.gaussians.count
    seen, error = torch.ones(count), torch.zeros(count)
    seen[7] = UNSEEN_PX / 2
    error[[3, 11]] = torch.tensor([1.0, 2.0])
    before = step.gaussians.means.clone()
    densify(step, Shares(seen, error), count + 1)
    assert step.gaussians.count == step.field.count == count + 1
    after = step.gaussians.means
    parents = before[[11, 3]]  # the worst first
    untouched = [index for index in range(count) if index not in (3, 7, 11)]
    assert all((after == before[index]).all(dim=1).any() for index in untouched)
    assert not any((after == before[index]).all(dim=1).any() for index in (3, 7, 11))
    torch.testing.assert_close((after[[11, 3]] + after[-2:]) / 2, parents)
    assert (step.gaussians.means[-2:] - parents).norm(dim=1).min() > 0
    step(Observation.of(make_frame(1), camera))  # optimiser and field fit the new number


def test_densify_splits_each_gaussian_once_up_to_target_count(step):
    count = step.gaussians.count
    shares = Shares(torch.ones(count), torch.arange(count).float())
    densify(step, shares, count)
    assert step.gaussians.count == count
    densify(step, shares, 5 * count)
    assert step.gaussians.count == 2 * count


def test_densify_keeps_entirely_unseen_scene(step):
    count = step.gaussians.count
    densify(step, Shares(torch.zeros(count), torch.zeros(count)), 2 * count)
    assert step.gaussians.count == count


def test_split_halves_keep_deformation_of_parent(step, make_frame, camera):
    with torch.no_grad():
        step.field.weights.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
    count = step.gaussians.count
    moved = step.field.deltas(0.4).detach()
    step.split(torch.tensor([5, 9]), halves)
    deltas = step.field.deltas(0.4).detach()
    assert torch.equal(deltas[:count], moved)
    assert torch.equal(deltas[count:], moved[[5, 9]])


def test_halves_lie_along_longest_axis_of_parent():
    turn = torch.tensor([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]], dtype=torch.float32)  # 45 degrees about z
    parent = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        quats=3 * turn,
        log_scales=torch.log(torch.tensor([[0.1, 0.8, 0.2]])),
        logit_opacities=torch.tensor([1.5]),
        sh=torch.full((1, 1, 3), 0.3),
    )
    first, second = halves(parent)
    across = (second.means - first.means)[0]
    torch.testing.assert_close(across.abs(), torch.tensor([0.8, 0.8, 0.0]) / 2**0.5, atol=1e-6, rtol=0)
    assert across[0] * across[1] < 0  # the turned y axis points to -x, +y
    torch.testing.assert_close((first.means + second.means) / 2, parent.means)
    for half in (first, second):
        torch.testing.assert_close(half.scales, torch.tensor([[0.1, 0.5, 0.2]]))
        for name in ("quats", "logit_opacities", "sh"):
            assert torch.equal(half.tensors()[name], parent.tensors()[name])


def test_halves_render_like_parent(step, camera):
    middle = step.gaussians.means[:, :2].norm(dim=1).argmin()
    one = step.gaussians.select(middle[None])
    whole = render(one, camera).alpha
    both = render(Gaussians.append(*halves(one)), camera).alpha
    assert whole.sum() > 5
    assert (both - whole).abs().sum() < 0.25 * whole.sum()


def test_densify_is_deterministic(make_frame, camera):
    seen = [Observation.of(make_frame(seq, shift_px=seq / 2), camera) for seq in range(3)]

    def densified():
        gaussians = gaussians_from_frame(make_frame(), camera, 120, sh_degree=0, default_depth_mm=60.0)
        config = dataclasses.replace(ReconstructorConfig(field="basis", gaussians=120))
        made = TrainingStep(gaussians, BasisField(gaussians.count, (0.0, 1.0), bumps=6), config, camera)
        for one in seen:
            made(one)
        densify(made, shares_of(made, seen), 150)
        return made.gaussians

    first, second = densified(), densified()
    assert all(torch.equal(a, b) for a, b in zip(first.tensors().values(), second.tensors().values(), strict=True))


def trained(step, make_frame, camera):
    """Give the opacities a gradient."""
    for seq in range(4):
        step(Observation.of(make_frame(seq, shift_px=seq), camera))
    return step


@pytest.mark.parametrize("more", [0, 15])
def test_birth_death_replaces_unseen_and_grows_to_target_count(step, make_frame, camera, more):
    trained(step, make_frame, camera)
    count = step.gaussians.count
    seen = torch.ones(count)
    seen[7] = UNSEEN_PX / 2
    gone = step.gaussians.means[7].clone()
    birth_death(step, Shares(seen, torch.zeros(count)), count + more)
    assert step.gaussians.count == count + more
    assert not (step.gaussians.means == gone).all(1).any()
    assert all(tensor.isfinite().all() for tensor in step.gaussians.tensors().values())


def test_birth_death_is_deterministic(step, make_frame, camera):
    trained(step, make_frame, camera)
    other = copy.deepcopy(step)
    for each in (step, other):
        birth_death(each, Shares(torch.ones(each.gaussians.count), torch.zeros(each.gaussians.count)), 120)
    torch.testing.assert_close(step.gaussians.means, other.gaussians.means, rtol=0, atol=0)


def test_relocated_copies_keep_opacity_and_brightness(device):
    parents = Gaussians(
        torch.zeros(2, 3),
        torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.zeros(2, 3),
        torch.tensor([-1.0, 2.0]),
        torch.zeros(2, 1, 3),
    ).to(device)
    first, second = relocated(parents)
    torch.testing.assert_close(1 - (1 - first.opacities) * (1 - second.opacities), parents.opacities)
    # The integral along a line through the common centre: o s = sum over both copies of o' s' - o'^2 s' / sqrt(2) / 2 each.
    o, s = first.opacities, first.scales[:, 0]
    torch.testing.assert_close(2 * o * s - o**2 * s / 2**0.5, parents.opacities * parents.scales[:, 0])
    assert (first.means != second.means).any(1).all()


def test_fit_with_birth_death_strategy_keeps_count(make_frame, camera):
    config = ReconstructorConfig(field="basis", gaussians=100, max_gaussians=100, strategy="birth_death")
    reconstructor = Reconstructor(config, camera)
    reconstructor.fit([make_frame(seq, shift_px=seq) for seq in range(4)], steps=20)
    assert reconstructor.gaussians == 100
    with pytest.raises(InvalidSetting, match="unknown strategy 'none'; known are streaming, birth_death, adc, mcmc"):
        ReconstructorConfig(strategy="none")
