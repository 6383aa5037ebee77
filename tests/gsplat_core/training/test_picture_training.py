"""Values of a renderer that are trained with the scene, with a renderer and a loss that note their calls."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch

from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.steps import step as step_module
from gsplat_core.training.steps.step import PictureTraining


class Renderer:
    rates: ClassVar[dict[str, float]] = {"density": 0.01}

    def first_values(self, distance: float) -> dict[str, float]:
        return {"density": 2 * distance, "other": 0.5}

    def picture(self, *given: Any) -> Any:
        return given


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> PictureTraining:
    monkeypatch.setattr(step_module, "RENDERERS", {"fake": Renderer()})
    return PictureTraining("fake", 30.0, torch.device("cpu"))


def scene(count: int = 3) -> Gaussians:
    return Gaussians(
        torch.zeros(count, 3), torch.ones(count, 4), torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 1, 3)
    )


def test_picture_training_values_restart_at_scene_distance(training: PictureTraining) -> None:
    assert {name: pytest.approx(float(value)) for name, value in training.values.items()} == {
        "density": 60.0,
        "other": 0.5,
    }
    training._logs["density"].fill_(0.0)
    adam = training._adam
    training.restart(10.0)
    assert float(training.values["density"]) == pytest.approx(20.0) and training._adam is not adam


def test_picture_training_step_updates_logarithms_at_renderer_rates(
    training: PictureTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    gradients = {"density": torch.tensor(0.25), "other": torch.tensor(-3.0)}
    steps, drawn = [], []
    observation = SimpleNamespace(camera="camera")

    def loss(given: Gaussians, values: Any, seen: Any, weights: Any, draw: Any, losses: Any) -> Any:
        drawn.append(draw(given, values, True))
        assert (seen, weights, losses) == (observation, "weights", "losses")
        return SimpleNamespace(loss=torch.tensor(7.0), gradients={"means": torch.ones(3, 3)}, values=gradients)

    monkeypatch.setattr(step_module, "loss_by_autograd", loss)
    monkeypatch.setattr(training._adam, "step", lambda *given: steps.append(given))
    given = scene()
    found = training(given, observation, "weights", "losses", 0.5)
    ((logs, by_log, rates),) = steps
    assert logs is training._logs
    assert {name: float(each) for name, each in by_log.items()} == {
        "density": pytest.approx(15.0),
        "other": pytest.approx(-1.5),
    }
    assert rates == {"density": 0.005, "other": 0.0}
    assert float(found.loss) == 7 and set(found.gradients) == set(given.tensors())
    assert all(not each.any() for name, each in found.gradients.items() if name != "means")
    assert bool(found.gradients["means"].all()) and found.gradients["sh"].shape == given.sh.shape
    assert drawn[0][:3] == (given, "camera", None) and float(drawn[0][3]["density"]) == pytest.approx(60.0)


def test_picture_training_step_follows_negative_gradient(
    training: PictureTraining, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        step_module, "loss_by_autograd",
        lambda *_: SimpleNamespace(loss=torch.tensor(1.0), gradients={}, values=dict.fromkeys(("density", "other"), torch.tensor(1.0))),
    )  # fmt: skip
    training(scene(), SimpleNamespace(camera=None), None, None, 1.0)
    assert math.log(float(training.values["density"])) == pytest.approx(math.log(60) - 0.01, abs=1e-4)
    assert float(training.values["other"]) == pytest.approx(0.5)
