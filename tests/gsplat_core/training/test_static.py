"""Training of a static scene from posed pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsplat_core import Camera
from gsplat_core.errors import InvalidSetting, RecordingInvalid
from gsplat_core.io.recordings.colmap import read_colmap
from gsplat_core.training.static import CompiledAdam, StaticConfig, StaticTrainer, TrainingCoordinates, read_points
from gsplat_core.training.strategies.adc import DefaultStrategy
from gsplat_core.training.strategies.mcmc import MCMCStrategy
from tests.colmap_writer import write_scene
from tests.gsplat_core.training.posed_pictures import posed_pictures

SHIFT = np.array([30.0, -20, 10])


def test_static_training_improves_psnr():
    pictures, points = posed_pictures()
    trainer = StaticTrainer(pictures, points, StaticConfig(60, "none", sh_degree=1))
    before = np.mean([trainer.psnr_db(k) for k in range(5)])
    seen = [trainer.step().picture for _ in range(60)]
    assert np.mean([trainer.psnr_db(k) for k in range(5)]) > before + 1
    assert all(sorted(seen[first : first + 5]) == [0, 1, 2, 3, 4] for first in range(0, 60, 5))


def test_static_training_is_independent_of_unit_and_origin():
    """The rates refer to the distance of the cameras, so the result in another unit is the converted one."""
    results = []
    for factor, shift in ((1.0, 0.0), (100.0, SHIFT)):
        trainer = StaticTrainer(*posed_pictures(factor, shift), StaticConfig(20, "none", sh_degree=1))
        for _ in range(20):
            trainer.step()
        results.append(trainer.gaussians())
    own, other = results
    moved = (other.means - torch.tensor(SHIFT, dtype=torch.float32)) / 100
    assert (moved - own.means).abs().max() < 2e-4
    assert (other.scales / 100 / own.scales - 1).abs().max() < 2e-3
    assert (other.opacities - own.opacities).abs().max() < 2e-3


def test_training_coordinates_centre_on_viewed_point():
    pictures, _ = posed_pictures(7.0, SHIFT)
    coordinates = TrainingCoordinates.of([each.camera for each in pictures])
    assert np.abs(coordinates.centre - SHIFT).max() < 7 * 0.3
    cameras = [coordinates.camera(each.camera) for each in pictures]
    assert np.median([np.linalg.norm(each.position) for each in cameras]) == pytest.approx(1)
    # One camera has no centre of attention.
    alone = TrainingCoordinates.of([pictures[0].camera])
    assert np.allclose(alone.centre, pictures[0].camera.position) and alone.factor == 1


@pytest.mark.parametrize(("strategy", "fewest", "most"), [("adc", 61, 200), ("mcmc", 66, 66), ("none", 60, 60)])
def test_static_strategy_changes_count_and_is_deterministic(strategy, fewest, most):
    pictures, points = posed_pictures()
    found = []
    for seed in (3, 3, 4):
        trainer = StaticTrainer(pictures, points, StaticConfig(30, strategy, max_gaussians=66, sh_degree=1), seed=seed)
        for _ in range(30):
            trainer.step()
        found.append(trainer.gaussians().means)
    assert fewest <= len(found[0]) <= most
    assert torch.equal(found[0], found[1])
    assert found[0].shape != found[2].shape or not torch.equal(found[0], found[2])


def test_static_strategy_schedule_equals_gsplat():
    generator = torch.Generator()
    adc, mcmc = (StaticConfig(strategy=name).new_strategy(200, generator) for name in ("adc", "mcmc"))
    assert (adc, mcmc) == (DefaultStrategy(generator=generator), MCMCStrategy(generator=generator))
    assert StaticConfig(absgrad=True).new_strategy(200, generator).grow_grad2d == 0.0008
    # In a short training every picture counts for each refinement, and there is time to recover from a reset.
    short = StaticConfig(steps=3000).new_strategy(28, generator)
    assert (short.refine_start_iter, short.refine_every, short.refine_stop_iter, short.reset_every) == (
        50,
        28,
        1500,
        300,
    )
    shorter = StaticConfig(steps=600).new_strategy(28, generator)
    assert shorter.reset_every == 600 and shorter.refine_stop_iter == 300


def test_compiled_adam_equals_torch_adam():
    generator = torch.Generator().manual_seed(1)
    ours, theirs = (torch.nn.Parameter(torch.ones(7, 3)) for _ in range(2))
    optimizers = CompiledAdam([ours], lr=0.01, eps=1e-15), torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    for _ in range(4):
        ours.grad = torch.randn(7, 3, generator=generator)
        theirs.grad = ours.grad.clone()
        for optimizer in optimizers:
            optimizer.step()
    assert torch.allclose(ours, theirs, atol=1e-7)
    assert optimizers[0].state[ours].keys() == optimizers[1].state[theirs].keys()
    before = ours.detach().clone()
    ours.grad = torch.full((7, 3), 1.0)
    ours.grad[2, 1] = torch.nan
    optimizers[0].step()
    unchanged = (ours == before).all(1)
    assert unchanged.tolist() == [row == 2 for row in range(7)]


@pytest.mark.parametrize(
    ("option", "value"), [("steps", 0), ("sh_degree", 5), ("sh_degree", -1), ("strategy", "x"), ("max_gaussians", 0)]
)
def test_static_config_refuses_options_out_of_range(option, value):
    with pytest.raises(InvalidSetting, match=option):
        StaticConfig(**{option: value})
    with pytest.raises(InvalidSetting, match="adc"):
        StaticConfig(strategy="mcmc", absgrad=True)


@pytest.mark.parametrize(("z", "is_refused"), [(9.0, False), (-9.0, True)])
def test_read_points_refuses_points_outside_all_images(tmp_path, z, is_refused):
    camera = Camera(np.array([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]]), 40, 30)
    # Only the last point can be inside the picture.
    points = [(float(x), 0.0, 2.0, 1, 2, 3) for x in (20, 21, 22)] + [(0.0, 0.0, z, 1, 2, 3)]
    write_scene(tmp_path / "sparse", [("0.png", camera)], text=True, points=points)
    scene = read_colmap(tmp_path)
    if is_refused:
        with pytest.raises(RecordingInvalid, match=r"none of the 4 points .* do not belong together"):
            read_points(scene)
    else:
        assert len(read_points(scene).positions) == 4
