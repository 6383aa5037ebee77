"""The breathing of synthetic recordings: its halves, its rate, and that nothing changes where none of it is asked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings import synthesize
from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, render_recording
from gsplat_core.io.recordings.synthetic.scene import CLEAR, Extras, SyntheticScene
from gsplat_core.io.recordings.synthetic.tissue import NO_TUG, PERIOD_S, Breathing

TIMES = np.arange(0, 20 * PERIOD_S, 0.004)


def lift(breathing: Breathing) -> np.ndarray:
    return np.sin([breathing.phase(float(t)) for t in TIMES])


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0, 3.5])
def test_breathing_ratio_is_expiration_to_inspiration_time(ratio: float) -> None:
    rises = np.diff(lift(Breathing(0.7, ratio))) > 0
    assert (~rises).sum() / rises.sum() == pytest.approx(ratio, rel=0.02)
    assert np.count_nonzero(rises[1:] & ~rises[:-1]) in (19, 20, 21)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("wander", [0.0, 0.3])
def test_breathing_phase_is_smooth_and_increasing(ratio: float, wander: float) -> None:
    phases = np.array([Breathing(-5.0, ratio, wander, (1.0, 4.0)).phase(float(t)) for t in TIMES])
    assert (np.diff(phases) > 0).all() and np.diff(phases).max() < 0.05
    assert np.abs(np.diff(phases, n=2)).max() < 5e-4


def test_breathing_rate_wander_has_given_amplitude_and_mean() -> None:
    phases = np.array([Breathing(0.0, 1.0, 0.15, (0.3, 2.0)).phase(float(t)) for t in TIMES])
    rates = np.gradient(phases, TIMES) * PERIOD_S / (2 * np.pi)
    assert 0.10 < rates.max() - 1 <= 0.1501 and 0.10 < 1 - rates.min() <= 0.1501
    assert rates.mean() == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_breathing_ratio_changes_rendered_depth() -> None:
    asked = RenderSettings(frames=3, width_px=48, height_px=40, fps=1, seed=2)
    usual, other = (
        render_recording(each)
        for each in (
            asked,
            RenderSettings(frames=3, width_px=48, height_px=40, fps=1, seed=2, extras=Extras(breathing_ratio=2.0)),
        )
    )
    assert usual.digest != other.digest
    assert any(np.abs(a.depth - b.depth).max() > 0.2 for a, b in zip(usual, other, strict=True))


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_tissue_point_follows_breathing_phase(ratio: float) -> None:
    tissue = SyntheticScene.from_seed(2, 48, 40, 5, False, Extras(breathing_ratio=ratio)).tissue
    times = np.arange(0, 3 * 3.4 * 9, 0.17)  # whole breaths and whole pulses
    z = np.array([tissue.position((0.0, 0.0), float(t), NO_TUG)[2] for t in times])
    breaths = np.sin([Breathing(tissue.breathing.start, ratio).phase(float(t)) for t in times])
    others = np.sin([Breathing(tissue.breathing.start, 3 - ratio).phase(float(t)) for t in times])
    # What breathing does not explain is the pulse, of 0.35 mm.
    assert np.std(z - 2.4 * breaths) == pytest.approx(0.35 / np.sqrt(2), rel=0.05)
    assert np.std(z - 2.4 * others) > 0.5


@pytest.mark.slow
def test_seeded_scope_path_depends_on_seed() -> None:
    def way(seed: int, path: str) -> np.ndarray:
        scene = SyntheticScene.from_seed(seed, 48, 40, 5, True, Extras(scope_path=path))
        return np.stack([scene.camera_at(t / 10).world_to_camera for t in range(50)])

    assert np.array_equal(way(1, "usual"), way(2, "usual"))
    first, second = way(1, "seeded"), way(2, "seeded")
    assert np.abs(first - second)[:, :3, 3].max() > 1 and np.array_equal(first, way(1, "seeded"))
    for each in (first, second):
        np.testing.assert_allclose(each[0], np.eye(4), atol=1e-12)
        assert 2 < np.linalg.norm(each[:, :3, 3], axis=1).max() < 40


def test_synthesize_description_lists_only_requested_extras(tmp_path: Path) -> None:
    folder = synthesize(
        tmp_path / "a", frames=2, width_px=48, height_px=40, seed=4, camera="moving", extras=Extras(smoke=0.5)
    )
    description = json.loads((folder / "recording.json").read_text())
    assert set(description["made_with"]) == {
        "scene", "third", "behind", "flow", "tracks", "smoke", "depth_noise_mm", "exposure_changes"
    }  # fmt: skip
    other = synthesize(tmp_path / "b", frames=2, width_px=48, height_px=40, seed=4, extras=Extras(rate_wander=0.1))
    assert json.loads((other / "recording.json").read_text())["made_with"]["rate_wander"] == 0.1
    assert CLEAR.described().keys() == description["made_with"].keys()


@pytest.mark.parametrize(
    "wrong",
    [{"breathing_ratio": 0.0}, {"breathing_ratio": 9.0}, {"breathing_ratio": float("nan")}, {"rate_wander": -0.1}, {"rate_wander": 0.9}, {"rate_wander": float("nan")}, {"scope_path": "other"}],
)  # fmt: skip
def test_extras_refuse_invalid_breathing_values(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidSetting, match=next(iter(wrong))):
        Extras(**wrong)
