"""CONTRIBUTING's recipe "A depth estimator": a tracked probe that measures distance, with an origin of its own, run through a replay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsplat_core.choices import DEPTHS
from gsplat_core.depth.maps import DepthMap, Estimator
from gsplat_core.geometry.measure import Measurement
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import synthesize
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, DepthOrigin, DepthSource, Frame
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings, replay
from operators.depth import FoundDepth

DISTANCE_MM = 80.0
PROBE = DepthOrigin("probe", relative_error=0.1, scale="metric", loss_weight_online=2.0)


class ProbeDepth(Estimator):
    """Depth of a level plane at the distance that a probe touched."""

    origin = PROBE
    evidence = "the probe"

    def estimate(self, frame: Frame, camera: Camera) -> DepthMap:
        size = frame.image.shape[:2]
        return DepthMap(np.full(size, DISTANCE_MM, np.float32), np.ones(size, np.float32), PROBE, metric=True)


@pytest.fixture
def probe():
    DEPTH_ORIGINS.add(PROBE.name, PROBE)
    DEPTHS.add("probe", ProbeDepth)
    yield
    DEPTHS.remove("probe")
    DEPTH_ORIGINS.remove(PROBE.name)


@pytest.fixture
def tiny(tmp_path):
    return synthesize(tmp_path / "tiny", frames=3, width_px=64, height_px=48, stereo=False)


@pytest.mark.usefixtures("probe")
def test_it_runs_through_a_replay_and_its_properties_reach_the_model(tiny, tmp_path):
    outcome = replay(ReplaySettings(recording=tiny, out=tmp_path / "out", depth="probe", steps_per_frame=1))
    found = outcome.find(FoundDepth)
    assert found.frames == {"probe": 3} and found.known_share == 1 and found.metric
    model = load_bundle(tmp_path / "out" / "model")
    assert replace(model.depth_source, errors=()) == DepthSource(PROBE, metric=True)
    assert len(model.depth_source.errors) == 3
    point = Measurement(model, 0.0).point(32, 24)
    assert point.depth == pytest.approx(DISTANCE_MM, rel=0.15)
    assert point.depth_error >= 0.1 * point.depth


@pytest.mark.usefixtures("probe")
def test_it_runs_through_a_reconstruction(tiny, tmp_path):
    reconstruct(ReplaySettings(recording=tiny, out=tmp_path / "out", depth="probe"), steps=2)
    source = load_bundle(tmp_path / "out" / "model").depth_source
    assert source.origin is PROBE and source.metric and all(each.relative >= 0.1 for each in source.errors)
