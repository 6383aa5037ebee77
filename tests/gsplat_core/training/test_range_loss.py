"""Range sensors: their simulation, their rendering and the loss `range`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsplat_core.choices import LOSSES, SENSORS
from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.scene.range_sensors import OctLine, RangeScan, StructuredLight, TimeOfFlight, simulate_scan
from gsplat_core.training.losses import LossContext
from gsplat_core.training.measured_losses import RangeLoss, range_loss, render_ranges
from gsplat_core.training.observations import Observation

SIZE = 24


@pytest.fixture
def camera():
    return Camera.from_focal(30.0, SIZE, SIZE)


def wall(z, device="cpu"):
    axis = torch.linspace(-30, 30, 24)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    count = x.numel()
    return Gaussians(
        torch.stack([x.reshape(-1), y.reshape(-1), torch.full((count,), z)], 1),
        torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        torch.tensor([2.0, 2.0, 0.05]).log().repeat(count, 1),
        torch.full((count,), 4.0),
        torch.zeros(count, 1, 3),
    ).to(device)


@pytest.mark.parametrize("name", ["time_of_flight", "structured_light", "oct_line"])
@pytest.mark.parametrize("form", ["column", "image"])
def test_render_ranges_equals_simulated_scan(camera, device, name, form):
    sensor = SENSORS[name](20.0, 60.0, 80, form)
    depth = np.full((SIZE, SIZE), 40.25, np.float32)
    scan = simulate_scan(depth, camera, sensor, np.random.default_rng(0), photons=np.inf, jitter_bins=0)
    rendered = render_ranges(wall(40.25, device), camera, sensor).cpu()
    assert rendered.shape == scan.counts.shape == (1 if form == "image" else SIZE, 80)
    measured = torch.tensor(scan.counts)
    if name == "oct_line":
        assert float(measured.sum()) == SIZE
    if name == "time_of_flight":
        assert scan.counts.argmax(1).max() > 40
    cumulated = [(h / h.sum(1, keepdim=True)).cumsum(1) for h in (rendered, measured)]
    assert float((cumulated[0] - cumulated[1]).abs().sum(1).max()) < 0.5  # bins


def test_simulated_scan_noise_follows_photon_count(camera):
    sensor = StructuredLight(20.0, 60.0, 40)
    depth = np.full((SIZE, SIZE), 40.5, np.float32)
    depth[:, 3] = 0
    scan = simulate_scan(depth, camera, sensor, np.random.default_rng(0), photons=1000, ambient=2.0)
    sums = scan.counts.sum(1)
    assert sums[3] < 150
    lit = np.delete(sums, 3)
    assert abs(lit.mean() - 1080) < 30
    assert 10 < lit.std() < 60
    again = simulate_scan(depth, camera, sensor, np.random.default_rng(0), photons=1000, ambient=2.0)
    np.testing.assert_array_equal(scan.counts, again.counts)


@pytest.mark.parametrize("offset", [-6.0, 0.4, 6.0])
def test_range_loss_gradient_moves_wall_to_measured_depth(camera, device, offset):
    sensor = TimeOfFlight(20.0, 60.0, 256)
    scan = simulate_scan(np.full((SIZE, SIZE), 40.0, np.float32), camera, sensor, np.random.default_rng(0))
    scene = wall(40.0 + offset, device).requires_grad_()
    mask = torch.ones(SIZE, SIZE, dtype=torch.uint8)
    observation = Observation(0, 0.0, camera, torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8), mask, None, ranges=scan)
    loss_of, context = RangeLoss(), LossContext([observation], lambda time_s: scene)
    loss = loss_of(scene, observation, context)
    loss.backward()
    down = scene.means.grad[:, 2].sum() * offset
    assert float(down) > 0
    right = loss_of(wall(40.0, device), observation, context)
    assert float(right) < 0.5 * float(loss.detach())
    assert loss_of(scene, replace(observation, ranges=None), context) is None
    assert LOSSES["range"] is RangeLoss


def test_range_loss_ignores_rows_without_returns():
    measured = torch.tensor([[0.0, 3, 1], [0, 0, 0]])
    assert float(range_loss(torch.tensor([[0.0, 6, 2], [5, 0, 0]]), measured)) < 1e-6
    assert float(range_loss(torch.tensor([[6.0, 0, 2], [5, 0, 0]]), measured)) > 0.1


def test_observation_keeps_range_scan_of_frame(camera):
    scan = RangeScan(StructuredLight(1.0, 2.0, 4), np.ones((SIZE, 4), np.float32))
    frame = Frame(0, 0, np.zeros((SIZE, SIZE, 3), np.uint8), ranges=scan)
    assert Observation.of(frame, camera).ranges is scan


def test_range_sensors_and_loss_refuse_invalid_arguments(camera):
    with pytest.raises(InvalidSetting, match="from 5 to 2"):
        TimeOfFlight(5, 2)
    with pytest.raises(InvalidSetting, match="form is 'row'"):
        TimeOfFlight(1, 2, form="row")
    with pytest.raises(InvalidSetting, match="the line is at 3"):
        OctLine(1, 2, row=3)
    with pytest.raises(InvalidInput, match=r"\[columns, 8\]"):
        RangeScan(StructuredLight(1, 2, 8), np.ones((3, 4), np.float32))
    with pytest.raises(InvalidInput, match="depth map is"):
        simulate_scan(np.ones((2, 2)), camera, StructuredLight(1, 2), np.random.default_rng(0))
    scan = RangeScan(StructuredLight(1.0, 2.0, 4), np.ones((5, 4), np.float32))
    image, mask = torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8), torch.ones(SIZE, SIZE, dtype=torch.uint8)
    observation = Observation(0, 0.0, camera, image, mask, None, ranges=scan)
    with pytest.raises(InvalidInput, match="5 columns, the picture 24"):
        RangeLoss()(wall(40.0), observation, LossContext([], lambda time_s: wall(40.0)))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_range_scan_refuses_invalid_counts(value):
    counts = np.zeros((4, 8), np.float32)
    counts[2, 3] = value
    with pytest.raises(InvalidInput, match="1 of 32 counts of a scan are negative, NaN or infinite"):
        RangeScan(StructuredLight(1, 9, 8), counts)


@pytest.mark.parametrize(
    ("argument", "value"),
    [("photons", -5.0), ("photons", np.nan), ("jitter_bins", -1.0), ("jitter_bins", np.nan), ("ambient", -1.0), ("ambient", np.inf)],
)  # fmt: skip
def test_simulate_scan_refuses_numbers_out_of_range(camera, argument, value):
    depth = np.full((camera.height_px, camera.width_px), 4.0)
    with pytest.raises(InvalidInput, match=f"{argument} is {value}; it must be 0 or more"):
        simulate_scan(depth, camera, StructuredLight(1, 9, 8), np.random.default_rng(0), **{argument: value})


def test_range_sensor_bins_must_be_whole_number():
    with pytest.raises(InvalidSetting, match=r"bins is 1\.5; it must be a whole number"):
        StructuredLight(1, 9, 1.5)
