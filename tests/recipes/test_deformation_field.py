"""The recipe "a deformation field" of CONTRIBUTING.md: two fields that only this file knows, from registration to a saved model."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from gsplat_core.deformation import FIELDS, Capabilities, DeformationField, FieldKind, FieldRates
from gsplat_core.errors import BundleCorrupt, InvalidInput, InvalidSetting
from gsplat_core.io.bundle import load_bundle
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.models import Model
from gsplat_core.scene.gaussians import Gaussians
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.value_ranges import IntegerIn, NumberIn
from operators.applications.replay import ReplaySettings, replay
from operators.metrics import QualityResult
from operators.reconstruct import ModelResult


class DriftField(DeformationField):
    """The least that a field has to be: the whole scene moves at one velocity."""

    kind = "drift"

    def __init__(self, time_window_s: tuple[float, float]) -> None:
        super().__init__(time_window_s)
        self.velocity = torch.nn.Parameter(torch.zeros(3))

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        passed_s = self.clamp_time(time_s) - self.time_window_s[0]
        return dataclasses.replace(gaussians, means=gaussians.means + passed_s * self.velocity)


@dataclasses.dataclass(frozen=True)
class PolynomialRates(FieldRates):
    """The rate of the coefficients."""

    coefficients_px: float = 0.3

    def rate_of(self, parameter: str) -> str:
        return "coefficients_px"


class PolynomialField(DeformationField):
    """A field with state of each Gaussian and a configuration: a polynomial in time for each path."""

    kind = "polynomial"

    def __init__(
        self, count: int, time_window_s: tuple[float, float], *, degree: int = 3, origin_s: float | None = None
    ) -> None:
        super().__init__(time_window_s)
        self.origin_s = time_window_s[0] if origin_s is None else origin_s
        self.coefficients = torch.nn.Parameter(torch.zeros(count, degree, 3))

    @classmethod
    def for_gaussians(
        cls, gaussians: Gaussians, time_window_s: tuple[float, float], **architecture: Any
    ) -> PolynomialField:
        return cls(gaussians.count, time_window_s, **architecture)

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(rows=self)

    @property
    def count(self) -> int:
        return self.coefficients.shape[0]

    def forward(self, gaussians: Gaussians, time_s: float) -> Gaussians:
        passed_s = self.clamp_time(time_s) - self.origin_s
        powers = torch.tensor([passed_s ** (k + 1) for k in range(self.coefficients.shape[1])])
        moved = torch.einsum("k,nkc->nc", powers.to(self.coefficients.device), self.coefficients)
        return dataclasses.replace(gaussians, means=gaussians.means + moved)

    def select(self, index: torch.Tensor) -> None:
        self.coefficients = torch.nn.Parameter(self.coefficients.data[index])

    def append(self, count: int, parents: torch.Tensor | None = None) -> None:
        known = self.coefficients.data
        new = known.new_zeros(count, *known.shape[1:]) if parents is None else known[parents]
        self.coefficients = torch.nn.Parameter(torch.cat([self.coefficients.data, new]))

    def config(self) -> dict[str, Any]:
        return {**super().config(), "degree": self.coefficients.shape[1], "origin_s": self.origin_s}


DRIFT = FieldKind(field=DriftField)
POLYNOMIAL = FieldKind(
    field=PolynomialField,
    config={"degree": IntegerIn(1, 8), "origin_s": NumberIn(-1e10, 1e10)},
    rates=PolynomialRates(),
)
EACH_KIND = pytest.mark.parametrize("kind", [DRIFT, POLYNOMIAL], ids=lambda kind: kind.name)


@pytest.fixture
def registered():
    """`registered(kind)` adds a kind for the time of a test."""
    added = []

    def add(kind: FieldKind[Any]) -> None:
        FIELDS.add(kind.name, kind)
        added.append(kind.name)

    yield add
    for name in added:
        FIELDS.remove(name)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """Half a second of moving tissue, seen by a camera that moves, so that Gaussians join."""
    folder = tmp_path_factory.mktemp("recordings") / "moving"
    return synthesize(folder, frames=12, fps=20, width_px=64, height_px=48, stereo=False)


def mean_psnr_db(model: Model, recording: Path) -> float:
    """Over the frames of the recording's last third."""
    opened = open_recording(recording)
    frames = list(opened)[8:]
    scores = [
        psnr_tissue_db(
            model.render(frame.time_s, opened.camera_at(frame.seq)).image.clamp(0, 1), frame.image, frame.mask
        )
        for frame in frames
    ]
    return sum(scores) / len(scores)


def without_motion(model: Model) -> Model:
    """Return the model with its Gaussians at rest."""
    return dataclasses.replace(model, field=None)


@EACH_KIND
def test_it_is_replayed_learns_and_is_saved_and_loaded(
    registered: Callable[[FieldKind[Any]], None], recording, tmp_path, kind, device
):
    registered(kind)
    settings = ReplaySettings(recording, tmp_path / "out", device=device.type, field=kind.name, steps_per_frame=12)
    outcome = replay(settings)
    assert outcome.settings.field == kind.name
    assert outcome.find(QualityResult).frames == 12
    model = outcome.find(ModelResult).model.to("cpu")
    assert isinstance(model.field, kind.field)
    assert all(bool(parameter.any()) for parameter in model.field.parameters())
    assert mean_psnr_db(model, recording) > mean_psnr_db(without_motion(model), recording) + 0.3
    loaded = load_bundle(tmp_path / "out" / "model")
    assert loaded.sha256() == model.sha256()
    assert torch.equal(loaded.render(0.3).image, model.render(0.3).image)


def test_gaussians_that_join_have_state_of_their_own(registered, recording, tmp_path):
    registered(POLYNOMIAL)
    opened = open_recording(recording)
    learning = Reconstructor(ReconstructorConfig(field="polynomial", gaussians=200, first_frame_steps=3), opened.camera)
    frames = list(opened)
    learning.observe(frames[0])
    started = learning.gaussians
    shifted = opened.camera.world_to_camera.copy()
    shifted[0, 3] -= 25  # a pull to the side: a strip of tissue comes into view
    for frame in frames[1:6]:
        learning.observe(frame.with_fields(pose=shifted))
    model = learning.snapshot()
    assert model.field.count == model.gaussians.count > started
    assert bool(model.field.coefficients[started:].any())


def test_a_bundle_with_a_field_that_is_not_registered_is_refused(registered, recording, tmp_path):
    registered(DRIFT)
    replay(ReplaySettings(recording, tmp_path / "out", field="drift", steps_per_frame=1, max_frames=2))
    FIELDS.remove("drift")
    try:
        with pytest.raises(BundleCorrupt, match="unknown deformation field 'drift'; known are basis, hexplane"):
            load_bundle(tmp_path / "out" / "model")
        with pytest.raises(InvalidSetting, match="field is 'drift'; choose auto, basis or hexplane"):
            replay(ReplaySettings(recording, tmp_path / "other", field="drift"))
    finally:
        FIELDS.add("drift", DRIFT)


def test_the_recipe_explains_every_capability():
    guide = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")
    recipe = guide[guide.index("### A deformation field") : guide.index("### A renderer")]
    assert [each.name for each in dataclasses.fields(Capabilities) if f"`{each.name}`" not in recipe] == []


def test_a_name_can_be_taken_once_only(registered):
    registered(DRIFT)
    with pytest.raises(InvalidInput, match="a deformation field named 'drift' already exists"):
        registered(DRIFT)
