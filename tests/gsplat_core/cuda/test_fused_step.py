"""The captured training step: learning, frames that exceed the capacity, and replaced tensors."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from gsplat_core import Camera, Gaussians, render
from gsplat_core.deformation.field import displaced
from gsplat_core.training.losses import EVERY, WeightedLosses
from gsplat_core.training.observations import Observation, RightEye
from gsplat_core.training.steps.fused_step import FusedStep
from gsplat_core.training.steps.optimiser import FusedAdam
from gsplat_core.training.steps.photometric import LossWeights

RATES = {"means": 1e-2, "quats": 2e-3, "log_scales": 5e-3, "logit_opacities": 2e-2, "sh": 1e-2}


class NoField:
    """Adds nothing and learns nothing."""

    rates = 0
    reads_positions = False

    def deltas(self, gaussians, time):
        return None

    def tensors(self):
        return ()

    def update(self, gradient, time, rates, step, status):
        self.gradient = gradient

    def add_colours(self, change, time):
        self.change = change


@pytest.fixture
def camera() -> Camera:
    return Camera.from_focal(90.0, 130, 90)


@pytest.fixture
def observation(make_gaussians, camera) -> Observation:
    """Return an observation of other Gaussians with depth and a tool in one corner."""
    with torch.no_grad():
        seen = render(make_gaussians(600, seed=4), camera)
    mask = torch.ones(camera.height_px, camera.width_px, dtype=torch.uint8)
    mask[:20, :30] = 0
    image = (seen.image.clamp(0, 1) * 255).round().to(torch.uint8)
    return Observation(seq=0, time_s=0.0, camera=camera, image=image, mask=mask, depth=seen.depth)


def train(
    gaussians: Gaussians, observation: Observation, weights: LossWeights, steps: int
) -> tuple[list[float], FusedAdam]:
    adam = FusedAdam(gaussians.tensors())
    step = FusedStep(gaussians, NoField(), adam, weights, observation.camera)
    losses = [float(step(gaussians, observation, 0.0, RATES, [])) for _ in range(steps)]
    assert step.settle() == 0
    assert adam.steps == steps
    return losses, adam


@pytest.mark.parametrize("weights", [LossWeights(squared=True), LossWeights(ssim=0.2, depth=0.5)])
def test_fused_step_colour_correction_equals_cpu(make_gaussians, observation, weights):
    """Correct colours by the residual for every loss; the other gradients follow the loss."""
    from gsplat_core.training.steps.photometric import loss_and_gradients

    seen = dataclasses.replace(observation, depth=None)
    start = make_gaussians(800, sh_degree=0)
    start.sh[::5, 0] = -2.5  # black, and held there by the clamp
    rates = dict.fromkeys(RATES, 0.0) | {"sh": 1e-2}
    changes, others = [], []
    for relaxation in (1.5, 0.75, 0.0):
        gaussians, field = start.clone().to("cuda"), NoField()
        step = FusedStep(gaussians, field, FusedAdam(gaussians.tensors()), weights, seen.camera)
        step(gaussians, seen, 0.0, rates, [], relaxation)
        if relaxation > 0:
            assert torch.equal(gaussians.sh.cpu(), start.sh)
            assert not field.gradient[:, 10:13].any()
            changes.append(field.change.cpu())
        else:
            assert not torch.equal(gaussians.sh.cpu(), start.sh)
        others.append(torch.cat([field.gradient[:, :10], field.gradient[:, 13:]], 1))
    for relaxation, change in zip((1.5, 0.75), changes, strict=True):
        expected = loss_and_gradients(start, seen, LossWeights(squared=True), relaxation).colour_change
        assert (change - expected).norm() <= 1e-3 * expected.norm()
    assert torch.equal(others[0], others[1])
    assert torch.equal(others[0], others[2])


def test_fused_step_alternates_colour_correction_and_training(make_gaussians, observation):
    seen = dataclasses.replace(observation, depth=None)
    gaussians, field = make_gaussians(300, sh_degree=0).to("cuda"), NoField()
    step = FusedStep(gaussians, field, FusedAdam(gaussians.tensors()), LossWeights(), seen.camera)
    losses = [float(step(gaussians, seen, 0.0, RATES, [], relaxation)) for relaxation in (0.0, 1.5, 1.5, 0.0, 1.5) * 4]
    assert step.settle() == 0
    assert losses[-1] < 0.95 * losses[0]


def test_fused_step_colour_correction_ignores_depth(make_gaussians, observation):
    """Steps with depth and steps with colour correction alternate in one memory, with one captured graph for each."""
    start, rates, depths = make_gaussians(600, sh_degree=0), RATES | {"sh": 0.0}, {}
    seen = dataclasses.replace(observation, depth=1.5 * observation.depth)
    for with_depth in (True, False):
        gaussians = start.clone().to("cuda")
        step = FusedStep(gaussians, NoField(), FusedAdam(gaussians.tensors()), LossWeights(depth=50.0), seen.camera)
        one = seen if with_depth else dataclasses.replace(seen, depth=None)
        for turn in range(40):
            step(gaussians, one, 0.0, rates, [], 0.0 if turn % 2 else 1.5)
        assert step.settle() == 0
        assert sorted(step._captured) == [(False, False, False), (True, False, False)]
        depths[with_depth] = float(gaussians.means[:, 2].median())
    assert depths[True] > depths[False] + 0.01
    corrected = []
    for one in (seen, dataclasses.replace(seen, depth=None)):
        gaussians = start.clone().to("cuda")
        step = FusedStep(gaussians, NoField(), FusedAdam(gaussians.tensors()), LossWeights(depth=50.0), seen.camera)
        for _ in range(3):
            step(gaussians, one, 0.0, RATES, [], 1.5)
        corrected.append(gaussians)
    for name, tensor in corrected[0].tensors().items():
        assert torch.equal(tensor, corrected[1].tensors()[name]), name


@pytest.mark.parametrize("relaxation", [0.0, 1.5])
def test_fused_step_right_eye_colours_equal_cpu(make_gaussians, observation, relaxation):
    """Alternating steps of both eyes with differently coloured pictures equal steps without a captured graph."""
    from gsplat_core.training.steps.photometric import loss_and_gradients, with_eye

    left = dataclasses.replace(observation, depth=None)
    right = dataclasses.replace(left, image=255 - left.image, of_right=True)
    start, weights = make_gaussians(600, sh_degree=0).with_right(), LossWeights(squared=True)
    rates = RATES | {"right_sh": 0.5e-2}
    shown, field = start.clone().to("cuda"), NoField()
    step = FusedStep(shown, field, FusedAdam(shown.tensors()), weights, left.camera)
    expected = start.clone()
    adam = FusedAdam(expected.tensors())
    for turn in range(8):
        one = right if turn % 2 else left
        step(shown, one, 0.0, rates, [], relaxation)
        compared = loss_and_gradients(expected.seen_by_right() if turn % 2 else expected, one, weights, relaxation)
        own = with_eye(compared.gradients, bool(turn % 2)) | {"sh" if turn % 2 else "right_sh": None}
        adam.step(expected.tensors(), own, rates)
        if compared.colour_change is not None and turn % 2:
            expected.right_sh[:, 0] += compared.colour_change
    assert step.settle() == 0
    assert expected.right_sh.abs().max() > 0.01
    for name, tensor in expected.tensors().items():
        change = (tensor - start.tensors()[name]).norm()
        assert (shown.tensors()[name].cpu() - tensor).norm() <= 0.02 * change + 1e-6, name


def test_fused_step_serves_alternating_cameras(make_gaussians, observation):
    """Each step renders with the pose and intrinsics of its observation, and equals training of both eyes on the CPU."""
    from gsplat_core.training.steps.photometric import loss_and_gradients

    left = dataclasses.replace(observation, depth=None)
    eye = left.camera.right_eye(0.3)
    K = eye.K.copy()
    K[0, 0], K[1, 2] = 1.02 * K[0, 0], K[1, 2] + 0.5
    eye = dataclasses.replace(eye, K=K)
    with torch.no_grad():
        picture = render(make_gaussians(600, seed=4), eye).image
    image = (picture.clamp(0, 1) * 255).round().to(torch.uint8)
    right = dataclasses.replace(left, camera=eye, image=image, mask=torch.ones_like(left.mask))
    pair = dataclasses.replace(left, right_eye=RightEye(lambda: right))
    weights, start = LossWeights(squared=True), make_gaussians(800, sh_degree=0)
    gaussians = start.clone().to("cuda")
    step = FusedStep(gaussians, NoField(), FusedAdam(gaussians.tensors()), weights, left.camera)
    losses = [float(step(gaussians, pair.by_turns(turn), 0.0, RATES, [])) for turn in range(12)]
    assert step.settle() == 0
    on_cpu, adam, expected = start.clone(), FusedAdam(start.tensors(), RATES), []
    for turn in range(12):
        loss, gradients, *_ = loss_and_gradients(on_cpu, pair.by_turns(turn), weights)
        expected.append(float(loss))
        adam.step(on_cpu.tensors(), gradients)
    assert losses == pytest.approx(expected, rel=2e-3)
    assert abs(expected[1] - expected[0]) > 0.01 * expected[0], "the eyes see different pictures"


@pytest.mark.parametrize("weights", [LossWeights(), LossWeights(ssim=0.2, depth=0.5), LossWeights(squared=True)])
def test_fused_step_training_equals_cpu(make_gaussians, observation, weights):
    from gsplat_core.training.steps.photometric import loss_and_gradients

    start = make_gaussians(800, sh_degree=1)
    gaussians = start.clone().to("cuda")
    losses, _ = train(gaussians, observation, weights, 12)

    on_cpu, adam, expected = start.clone(), FusedAdam(start.tensors(), RATES), []
    for _ in range(12):
        loss, gradients, *_ = loss_and_gradients(on_cpu, observation, weights)
        expected.append(float(loss))
        adam.step(on_cpu.tensors(), gradients)
    assert losses == pytest.approx(expected, rel=2e-3)
    assert losses[-1] < 0.95 * losses[0]
    for name, tensor in gaussians.tensors().items():
        moved = (on_cpu.tensors()[name] - start.tensors()[name]).norm()
        assert (tensor.cpu() - on_cpu.tensors()[name]).norm() < 0.02 * moved, name


def test_fused_step_is_deterministic(make_gaussians, observation):
    results = []
    for _ in range(2):
        gaussians = make_gaussians(3000, sh_degree=2).to("cuda")
        losses, _ = train(gaussians, observation, LossWeights(0.2, 0.1), 8)
        results.append((losses, gaussians))
    assert results[0][0] == results[1][0]
    for name, tensor in results[0][1].tensors().items():
        assert torch.equal(tensor, results[1][1].tensors()[name])


def test_fused_step_overflowed_frame_changes_nothing_and_next_fits(make_gaussians, observation, camera):
    # Each of these covers most of the picture: more instances than the lists have room for at first.
    scene = make_gaussians(4000)
    gaussians = dataclasses.replace(scene, log_scales=torch.full_like(scene.log_scales, 2.3)).to("cuda")
    before = gaussians.clone()
    adam = FusedAdam(gaussians.tensors())
    step = FusedStep(gaussians, NoField(), adam, LossWeights(), camera)
    for _ in range(3):
        step(gaussians, observation, 0.0, RATES, [])
    assert step.settle() == 3
    assert adam.steps == 0
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(tensor, before.tensors()[name])
        assert not adam.first_moments[name].any()
    losses = [float(step(gaussians, observation, 0.0, RATES, [])) for _ in range(5)]
    assert step.settle() == 0
    assert adam.steps == 5
    assert losses[-1] < losses[0]


def test_fused_step_recaptures_replaced_tensors(make_gaussians, observation, camera):
    gaussians = make_gaussians(500).to("cuda")
    adam = FusedAdam(gaussians.tensors())
    step = FusedStep(gaussians, NoField(), adam, LossWeights(), camera)
    for _ in range(3):
        step(gaussians, observation, 0.0, RATES, [])
    more = gaussians.append(make_gaussians(300, seed=9).to("cuda"))
    adam.append(300)
    old = gaussians.clone()
    for _ in range(3):
        step(more, observation, 0.0, RATES, [])
    assert step.settle() == 0
    for name, tensor in old.tensors().items():
        assert torch.equal(tensor, gaussians.tensors()[name])
    assert not torch.equal(more.means[500:], make_gaussians(300, seed=9).means.cuda())


class ConstantDeltas(NoField):
    """Adds the same deltas at all times and learns nothing."""

    def __init__(self, count):
        self.added = torch.zeros(count, 16, device="cuda")
        self.added[:, :10] = 0.05 * torch.randn(count, 10, generator=torch.Generator().manual_seed(2)).cuda()

    def deltas(self, gaussians, time):
        return self.added


@pytest.fixture(params=[(130, 90), (260, 180)], ids=["full size", "half size"])
def wall_seen(request) -> Observation:
    """Picture and depth of opaque flat splats on a slanted plane, with a tool in one corner."""
    camera = Camera.from_focal(0.7 * request.param[0], *request.param)
    with torch.no_grad():
        seen = render(slanted_wall(0.3, 10.0), camera)
    mask = torch.ones(camera.height_px, camera.width_px, dtype=torch.uint8)
    mask[:20, :30] = 0
    image = (seen.image.clamp(0, 1) * 255).round().to(torch.uint8)
    return Observation(seq=0, time_s=0.0, camera=camera, image=image, mask=mask, depth=seen.depth)


def slanted_wall(slope: float, distance: float) -> Gaussians:
    x, y = torch.meshgrid(torch.arange(-9.0, 9.1, 0.4), torch.arange(-7.0, 7.1, 0.4), indexing="xy")
    x, y = x.ravel(), y.ravel()
    random = torch.Generator().manual_seed(5)
    means = torch.stack([x, y, distance + slope * x], 1)
    quats = torch.nn.functional.normalize(
        torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(len(x), 4, generator=random), dim=1
    )
    scales = torch.tensor([0.35, 0.3, 0.05]).log().repeat(len(x), 1)
    colours = torch.rand(len(x), 1, 3, generator=random) - 0.5
    return Gaussians(means, quats, scales, torch.full((len(x),), 3.0), colours)


@pytest.mark.parametrize("relaxation", [0.0, 1.5])
def test_fused_step_ray_losses_equal_cpu(wall_seen, relaxation):
    """Alternating steps with and without rays on a deformed scene, with and without colour correction."""
    from gsplat_core.training.losses import LossContext
    from gsplat_core.training.steps.photometric import loss_and_gradients, with_losses

    chosen = {"ray_depth": 2.0, "normal_consistency": 1.0}
    start, weights = slanted_wall(0.2, 10.5), LossWeights(squared=True)
    gaussians, field = start.clone().to("cuda"), ConstantDeltas(start.count)
    step = FusedStep(
        gaussians, field, FusedAdam(gaussians.tensors()), weights, wall_seen.camera, WeightedLosses(chosen)
    )
    losses = [float(step(gaussians, wall_seen, 0.0, RATES, [], relaxation)) for _ in range(13)]
    assert step.settle() == 0
    assert sorted(step._captured) == [(relaxation > 0, False, False), (relaxation > 0, False, True)]

    expected, adam, losses_there = start.clone(), FusedAdam(start.tensors()), WeightedLosses(chosen)
    context, values = LossContext((), lambda _: expected), []
    for _ in range(13):
        deformed = displaced(expected, field.added.cpu())
        compared = loss_and_gradients(deformed, wall_seen, weights, relaxation)
        compared = with_losses(compared, deformed, lambda scene: losses_there(scene, wall_seen, context))
        values.append(float(compared.loss))
        adam.step(expected.tensors(), compared.gradients, RATES)
    assert losses == pytest.approx(values, rel=5e-3)
    assert values[EVERY] > 1.5 * values[EVERY - 1], "one of EVERY steps compares rays"
    for name, tensor in expected.tensors().items():
        change = (tensor - start.tensors()[name]).norm()
        assert (gaussians.tensors()[name].cpu() - tensor).norm() <= 0.1 * change + 1e-6, name


def test_fused_step_ray_losses_read_camera_and_depth_of_observation(wall_seen):
    """With one graph for two cameras, each loss equals that of a step captured for this camera alone."""
    other_camera = dataclasses.replace(wall_seen.camera, K=wall_seen.camera.K * [[1.1], [1.1], [1.0]])
    other = dataclasses.replace(wall_seen, camera=other_camera, depth=1.2 * wall_seen.depth)
    still = dict.fromkeys(RATES, 0.0)

    def ray_losses(observations):
        gaussians = slanted_wall(0.2, 10.5).to("cuda")
        losses = WeightedLosses({"ray_depth": 2.0, "normal_consistency": 1.0})
        step = FusedStep(gaussians, NoField(), FusedAdam(gaussians.tensors()), LossWeights(), wall_seen.camera, losses)
        return [float(step(gaussians, one, 0.0, still, [])) for one in observations][::EVERY]

    alone = ray_losses([wall_seen] * (EVERY + 1)), ray_losses([other] * (EVERY + 1))
    assert abs(alone[1][0] - alone[0][0]) > 0.1 * alone[0][0]
    by_turns = ray_losses([wall_seen] * (EVERY + 1) + [other] * EVERY + [wall_seen])
    assert by_turns == pytest.approx([alone[0][0], alone[0][0], alone[1][0]], rel=1e-5)


def test_fused_step_overflowed_rays_change_nothing_and_next_fit(make_gaussians, observation):
    scene = make_gaussians(4000)
    gaussians = dataclasses.replace(scene, log_scales=torch.full_like(scene.log_scales, 2.3)).to("cuda")
    before, adam = gaussians.clone(), FusedAdam(gaussians.tensors())
    losses = WeightedLosses({"ray_depth": 2.0, "normal_consistency": 1.0})
    step = FusedStep(gaussians, NoField(), adam, LossWeights(), observation.camera, losses)
    step(gaussians, observation, 0.0, RATES, [])
    assert step.settle() == 1
    assert adam.steps == 0
    for name, tensor in gaussians.tensors().items():
        assert torch.equal(tensor, before.tensors()[name])
        assert not adam.first_moments[name].any()
    for _ in range(8):
        step(gaussians, observation, 0.0, RATES, [])
    assert step.settle() == 0
    for name, tensor in gaussians.tensors().items():
        assert tensor.isfinite().all() and not torch.equal(tensor, before.tensors()[name])
