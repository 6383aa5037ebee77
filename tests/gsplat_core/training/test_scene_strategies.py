"""Strategies of offline reconstructions: rows of deforming Gaussians, schedules, caps, seeds and combinations."""

import dataclasses

import pytest
import torch

from gsplat_core.choices import STRATEGIES
from gsplat_core.deformation import BasisField
from gsplat_core.errors import InvalidSetting
from gsplat_core.ops.image_loss import image_loss
from gsplat_core.rendering.rasterization import rasterization
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.observations import Observation
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.steps.step import TrainingStep
from gsplat_core.training.strategies.adc import CappedAdc
from gsplat_core.training.strategies.mcmc import SceneMcmc
from gsplat_core.training.strategies.strategy import Plan, change_rows, draw, remove, split

COUNT = 90


@pytest.fixture(params=[False, True], ids=["exact", "preallocated"])
def step(make_frame, camera, request):
    gaussians = gaussians_from_frame(make_frame(), camera, COUNT, sh_degree=0, default_depth_mm=60.0)
    gaussians = dataclasses.replace(gaussians, extra={"label": torch.arange(float(COUNT))})
    config = ReconstructorConfig(
        field="basis", gaussians=COUNT, max_gaussians=300, preallocate=request.param, strategy="adc"
    )
    made = TrainingStep(gaussians, BasisField(COUNT, (0.0, 1.0), bumps=6), config, camera)
    with torch.no_grad():
        made.field.weights.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
    made(Observation.of(make_frame(1, shift_px=1), camera))
    return made


def test_change_rows_keeps_field_moments_extra_and_statistics_aligned(step, make_frame, camera):
    """`split` changes the order of rows, and `remove` leaves gaps."""
    deltas, before = step.field.deltas(0.4).detach().clone(), step.gaussians.detach().clone()
    averages = step.moments("means")["exp_avg"]
    state = {"count": torch.arange(float(COUNT)), "scene_scale": 2.0}
    divided, leaving = (torch.zeros(COUNT, dtype=torch.bool) for _ in range(2))
    divided[[3, 60]], leaving[[5, 88]] = True, True

    def change(params, optimizers):
        remove(params, optimizers, state, leaving)
        split(params, optimizers, state, divided[~leaving])

    change_rows(step, state, change)
    source = state["count"].long()
    assert sorted(source.tolist()) == sorted([each for each in range(COUNT) if each not in (5, 88)] + [3, 60])
    assert step.gaussians.count == step.field.count == COUNT and state["scene_scale"] == 2.0
    assert torch.equal(step.field.deltas(0.4).detach(), deltas[source])
    kept = ~divided[source]
    assert torch.equal(step.gaussians.means[kept], before.means[source][kept])
    assert torch.equal(step.gaussians.sh, before.sh[source])
    assert torch.equal(step.moments("means")["exp_avg"], averages[source] * kept[:, None])
    assert not torch.equal(step.gaussians.means[~kept], before.means[source][~kept])
    assert (step.gaussians.extra["label"] - source).abs().max() < 0.1  # trained by one step
    step(Observation.of(make_frame(2), camera))


def test_training_step_keeps_screen_gradients_for_strategies(step, make_frame, camera):
    seen = Observation.of(make_frame(2), camera)
    scene = step.at(seen.time_s)
    viewmat, intrinsics = (matrix[None] for matrix in camera.matrices("cpu"))
    picture, _, info = rasterization(
        scene.means.requires_grad_(), scene.quats, scene.scales, scene.opacities, scene.sh, viewmat, intrinsics,
        camera.width_px, camera.height_px, sh_degree=0, packed=False,
    )  # fmt: skip
    info["means2d"].retain_grad()
    image_loss(picture[0], seen.image, seen.mask).loss.backward()
    step(seen)
    torch.testing.assert_close(step.screen.means2d, info["means2d"].grad[0], rtol=1e-3, atol=1e-7)
    assert torch.equal(step.screen.radii, info["radii"][0])


def test_capped_adc_grows_largest_gradients_up_to_cap():
    gradients = torch.tensor([1.0, 5.0, 3.0, 4.0, 2.0])
    strategy = CappedAdc(cap_max=7, grow_grad2d=1.5)
    state = {"grad2d": gradients, "count": torch.ones(5), "scene_scale": 1.0}
    params = {"scales": torch.tensor([-9.0, 0.0, -9.0, -9.0, 0.0])[:, None].expand(5, 3)}
    copied, divided = strategy._to_grow(params, state, 600)
    assert copied.tolist() == [False, False, False, True, False]
    assert divided.tolist() == [False, True, False, False, False]


@pytest.mark.parametrize("name", ["adc", "mcmc"])
def test_fit_with_strategy_respects_cap_and_is_deterministic(name, tissue_video, camera):
    config = ReconstructorConfig(field="basis", gaussians=200, max_gaussians=225, strategy=name, squared_error=True)
    ends, counts = [], []
    for _ in range(2):
        learning = Reconstructor(config, camera, seed=3)
        learning.fit(tissue_video(3), 60, lambda *_, learning=learning: counts.append(learning.gaussians))
        ends.append(learning.snapshot())
    assert all(torch.equal(a, b) for a, b in zip(*(e.gaussians.tensors().values() for e in ends), strict=True))
    changes = [number + 1 for number in range(59) if counts[number] != counts[number + 1]]
    assert changes and all(number % 10 == 0 for number in changes)
    assert max(counts) <= 225 and (name == "adc" or counts[59] == 225)


def test_scene_mcmc_relocates_dead_gaussians_with_motion(make_frame, camera):
    gaussians = gaussians_from_frame(make_frame(), camera, COUNT, sh_degree=0, default_depth_mm=60.0)
    config = ReconstructorConfig(field="basis", gaussians=COUNT, max_gaussians=COUNT, strategy="mcmc")
    step = TrainingStep(gaussians, BasisField(COUNT, (0.0, 1.0), bumps=6), config, camera)
    with torch.no_grad():
        step.field.weights.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
        step.gaussians.logit_opacities[:40] = -9.0
    seen = Observation.of(make_frame(1), camera)
    step(seen)
    strategy = SceneMcmc(Plan(step, [seen], 100, COUNT, None, seed=1))
    before = step.field.deltas(0.4).detach()[40:]
    assert not strategy.before_step(1, 1.0)  # noise only
    assert strategy.before_step(10, 1.0)
    assert step.gaussians.count == COUNT and step.gaussians.opacities.min() > 0.004
    after = step.field.deltas(0.4).detach()
    assert all((before == row).all(1).any() for row in after)


def test_mcmc_loss_weights_can_be_overridden(make_frame, camera):
    seen = Observation.of(make_frame(1), camera)
    gaussians = gaussians_from_frame(make_frame(), camera, COUNT, sh_degree=0, default_depth_mm=60.0)
    loss = {}
    for name, options in {"none": {}, "mcmc": {"strategy": "mcmc"},
                          "own": {"strategy": "mcmc", "losses": ("opacity:1", "scale:1")}}.items():  # fmt: skip
        config = ReconstructorConfig(field="basis", gaussians=COUNT, **options)
        made = TrainingStep(gaussians.clone(), BasisField(COUNT, (0.0, 1.0), bumps=6), config, camera)
        loss[name] = float(made(seen))
    expected = float(gaussians.opacities.mean() + gaussians.scales.mean() / gaussians.means[:, 2].median())
    assert loss["mcmc"] - loss["none"] == pytest.approx(0.01 * expected, rel=1e-3)
    assert loss["own"] - loss["none"] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", ["adc", "mcmc"])
def test_alpha_strategies_are_refused_for_other_renderers(name):
    with pytest.raises(InvalidSetting, match=f"strategy '{name}' uses .* choose renderer alpha, or strategy streaming"):
        ReconstructorConfig(renderer="weighted_sum", strategy=name)
    assert ReconstructorConfig(renderer="points", strategy=name).strategy == name
    assert STRATEGIES[name].library is not None


@pytest.mark.parametrize("count", [1000, (1 << 24) + 2])
def test_draw_is_proportional_to_weights_beyond_2_24_entries(count):
    """`torch.multinomial` takes up to 2^24 of them."""
    weights = torch.zeros(count)
    weights[7], weights[count - 1] = 1.0, 3.0
    drawn = draw(weights, 4000, torch.Generator().manual_seed(0))
    found, counts = drawn.unique(return_counts=True)
    assert drawn.dtype == torch.int64 and found.tolist() == [7, count - 1]
    assert counts[1] / 4000 == pytest.approx(0.75, abs=0.03)
