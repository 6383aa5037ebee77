"""Evaluation of a static scene with stand-ins for the scene, the model and the renderer."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsplat_core.errors import InvalidSetting
from operators.applications import static_scene
from operators.applications.static_scene import evaluate_scene

SIZES = {"0.png": (16, 12), "8.png": (16, 12), "16.png": (20, 12)}
LEVELS = {"0.png": 0.5, "8.png": 0.3, "16.png": 0.45}
"""Level of each rendered picture; that of the image files is 0.5."""


class Run:
    """Record of the calls that an evaluation makes."""

    def __init__(self, patch: pytest.MonkeyPatch, device: str) -> None:
        self.memory: list[int] = []
        self.renderers: list[Any] = []
        self.checked: list[Any] = []
        self.events: list[tuple[int, int]] = []
        model = SimpleNamespace(
            parameter_count=100, time_window_s=(0.0, 3.0), gaussians=SimpleNamespace(count=7), to=lambda device: model
        )
        held_out = [SimpleNamespace(name=name) for name in SIZES]
        scene = SimpleNamespace(held_out=lambda every: held_out[:: every // 8], read=self.read)
        for name, value in {
            "check_device": self.checked.append, "check_renderer": lambda *given, **_: self.checked.append(given),
            "check_picture": lambda camera, scale: self.checked.append(camera.name), "read_colmap": lambda path: scene,
            "load_model": lambda source: model, "new_renderer": self.renderer, "render_bytes": lambda *given: sum(given),
            "require_memory": lambda needed, *_: self.memory.append(needed),
        }.items():  # fmt: skip
            patch.setattr(static_scene, name, value)
        self.settings = SimpleNamespace(
            device=device, renderer="alpha", options=None, scene=Path("scene"), every=8, images="images", scale=0.5
        )

    def read(self, posed: Any, images: str, scale: float) -> tuple[Any, np.ndarray]:
        assert (images, scale) == ("images", 0.5)
        width, height = SIZES[posed.name]
        return SimpleNamespace(width_px=width, height_px=height, name=posed.name), np.full(
            (height, width, 3), 128, np.uint8
        )

    def renderer(self, name: str, camera: Any, device: str, options: Any) -> Any:
        def render(camera: Any, time_s: float, outputs: Any) -> Any:
            assert (time_s, outputs) == (3.0, ("image",))
            image = torch.full((camera.height_px, camera.width_px, 3), LEVELS[camera.name])
            return SimpleNamespace(result=lambda: SimpleNamespace(image=image))

        made = SimpleNamespace(render=render, prepare=lambda model: self.renderers.append(camera.name))
        return made

    def evaluated(self, folder: Path | None = None, stops_after: int = 99) -> Any:
        return evaluate_scene(
            Path("model"), self.settings, folder, stop_requested=lambda: len(self.events) >= stops_after,
            progress=lambda progress: self.events.append((progress.done, progress.total)),
        )  # fmt: skip


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_scene_evaluation_creates_one_renderer_per_image_size(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    run = Run(monkeypatch, device)
    run.evaluated()
    assert run.renderers == ["0.png", "16.png"]
    assert run.memory == ([16 + 12 + 100, 20 + 12 + 100] if device == "cpu" else [])
    assert run.checked[0] == device and run.checked[2:] == ["0.png", "16.png"]
    assert run.events == [(1, 3), (2, 3), (3, 3)]


def test_scene_evaluation_reports_mean_scores_and_worst_image(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = Run(monkeypatch, "cpu").evaluated(tmp_path)
    expected = [-20 * np.log10(abs(level - 128 / 255)) for level in LEVELS.values()]
    assert [each.psnr_db for each in found.images] == pytest.approx(expected, abs=0.01)
    assert found.psnr_db == pytest.approx(np.mean(expected), abs=0.01)
    assert (found.worst, found.worst_db) == ("8.png", pytest.approx(expected[1], abs=0.01))
    assert found.ssim == pytest.approx(np.mean([each.ssim for each in found.images])) and found.gaussians == 7
    written = json.loads((tmp_path / static_scene.EVALUATION_FILE).read_text())
    assert written["psnr_db"] == found.psnr_db and len(written["images"]) == 3
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["0000.png", "0001.png", "0002.png"]


def test_interrupted_scene_evaluation_scores_finished_images(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(Run(monkeypatch, "cpu").evaluated(stops_after=2).images) == 2
    with pytest.raises(InvalidSetting, match="before its first image"):
        Run(monkeypatch, "cpu").evaluated(stops_after=0)
