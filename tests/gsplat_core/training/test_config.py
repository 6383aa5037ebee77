"""Settings that make no sense are refused with the name and the value."""

import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.training.config import LearningRates, ReconstructorConfig


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("field", "voxels"),
        ("gaussians", 0),
        ("max_gaussians", 29_999),
        ("sh_degree", 5),
        ("steps_per_frame", 0),
        ("first_frame_steps", -1),
        ("newest_share", 0.0),
        ("newest_share", 1.1),
        ("window_frames", 0),
        ("bump_spacing_s", 0.0),
        ("bump_spacing_s", float("nan")),
        ("ssim_weight", -0.1),
        ("ssim_weight", 1.1),
        ("depth_weight", float("inf")),
        ("default_depth_mm", -60.0),
    ],
)
def test_a_wrong_setting_is_named_with_its_value(name, value):
    with pytest.raises(InvalidInput, match=name) as refused:
        ReconstructorConfig(**{name: value})
    assert str(value) in str(refused.value)


@pytest.mark.parametrize("rate", [-1e-3, 10.0, float("nan")])
def test_a_wrong_rate_is_named_with_its_value(rate):
    with pytest.raises(InvalidInput, match=f"basis_quats is {rate}"):
        LearningRates(basis_quats=rate)


@pytest.mark.parametrize(("field", "chosen"), [("auto", "basis"), ("basis", "basis"), ("hexplane", "hexplane")])
def test_auto_stands_for_the_basis_field(field, chosen):
    assert ReconstructorConfig(field=field).chosen_field == chosen
