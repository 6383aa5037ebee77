"""An engine on a CPU measures once and caches the size that the machine sustains while serving viewers."""

from __future__ import annotations

import json

import pytest

from gsplat_core.scene.cameras import Camera
from operators.applications.working_size import choose_working_size
from operators.sources.source import SourceDescription
from services.supervisor.engine import SHARE_OF_INTERVAL, engine_scale
from services.supervisor.worker import EngineSpec


def stream(width_px=640, height_px=512, fps=30.0):
    return SourceDescription("scope", width_px, height_px, fps, Camera.from_focal(width_px, width_px, height_px))


class Machine:
    """Simulated machine that takes 2 ms per frame and 180 ms per million pixels."""

    def __init__(self):
        self.measured = 0

    def __call__(self, about, share):
        self.measured += 1
        pixels = about.width_px * about.height_px
        return choose_working_size(about, lambda scale: 2e-3 + 0.18e-6 * scale**2 * pixels, share)


def test_engine_scale_uses_half_of_frame_interval(tmp_path):
    scale = engine_scale(EngineSpec(), stream(), tmp_path / "size", Machine())
    pixels = scale**2 * 640 * 512
    assert 0.75 < (2e-3 + 0.18e-6 * pixels) * 30 / SHARE_OF_INTERVAL <= 1


def test_engine_scale_is_measured_once_and_cached(tmp_path):
    machine, kept = Machine(), tmp_path / "size"
    first = engine_scale(EngineSpec(), stream(), kept, machine)
    assert engine_scale(EngineSpec(), stream(), kept, machine) == first and machine.measured == 1


@pytest.mark.parametrize("other", [stream(1280, 1024), stream(fps=60.0)])
def test_engine_scale_is_measured_again_for_other_source(tmp_path, other):
    machine, kept = Machine(), tmp_path / "size"
    engine_scale(EngineSpec(), stream(), kept, machine)
    engine_scale(EngineSpec(), other, kept, machine)
    assert machine.measured == 2


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", "{}", '{"size": [640, 512, 30.0], "scale": "x"}', '{"size": [640, 512, 30.0], "scale": null}',
             '{"size": [640, 512, 30.0], "scale": 0}', '{"size": [640, 512, 30.0], "scale": 9}', '{"size": 3, "scale": 0.5}'],
)  # fmt: skip
def test_engine_scale_replaces_damaged_cache_file(tmp_path, text):
    machine, kept = Machine(), tmp_path / "size"
    kept.write_text(text)
    scale = engine_scale(EngineSpec(), stream(), kept, machine)
    assert machine.measured == 1 and json.loads(kept.read_text())["scale"] == scale


def test_engine_scale_is_not_measured_if_set_or_on_gpu(tmp_path):
    machine, kept = Machine(), tmp_path / "size"
    assert engine_scale(EngineSpec(engine_scale=0.75), stream(), kept, machine) == 0.75
    assert engine_scale(EngineSpec(device="cuda"), stream(), kept, machine) == 1.0
    assert engine_scale(EngineSpec(device="cuda", engine_scale=0.5), stream(), kept, machine) == 0.5
    assert machine.measured == 0 and not kept.exists()


def test_engine_scale_cache_keeps_frame_time_in_milliseconds(tmp_path):
    scale = engine_scale(EngineSpec(), stream(), tmp_path / "size", Machine())
    kept = json.loads((tmp_path / "size").read_text())
    assert kept["size"] == [640, 512, 30.0]
    assert kept["frame_ms"] == pytest.approx(2 + 0.18e-3 * scale**2 * 640 * 512, abs=0.06)
