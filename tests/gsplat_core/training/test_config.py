"""Settings that make no sense are refused with the name and the value."""

import dataclasses

import numpy as np
import pytest

from gsplat_core.deformation.basis import BasisLearningRates
from gsplat_core.deformation.hexplane import HexPlaneLearningRates
from gsplat_core.errors import InvalidSetting, UserError
from gsplat_core.scene.frames import DEPTH_ORIGINS
from gsplat_core.training.config import (
    LearningRates,
    ReconstructorConfig,
)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("field", "voxels"),
        ("gaussians", 0),
        ("max_gaussians", 29_999),
        ("sh_degree", 5),
        ("steps_per_frame", 0),
        ("first_frame_steps", -1),
        ("window_frames", 0),
        ("motion_spacing_s", 0.0),
        ("motion_spacing_s", float("nan")),
        ("ssim_weight", -0.1),
        ("ssim_weight", 1.1),
        ("depth_weight", float("inf")),
        ("default_depth_mm", -60.0),
    ],
)
def test_reconstructor_config_error_names_setting_and_value(name, value):
    with pytest.raises(InvalidSetting, match=name) as refused:
        ReconstructorConfig(**{name: value})
    assert str(value) in str(refused.value)


@pytest.mark.parametrize("rate", [-1e-3, 10.0, float("nan")])
@pytest.mark.parametrize(
    ("kind", "name"), [(LearningRates, "quats"), (BasisLearningRates, "timing"), (HexPlaneLearningRates, "parameters")]
)
def test_learning_rates_error_names_rate_and_value(kind, name, rate):
    with pytest.raises(InvalidSetting, match=f"{name} is {rate}"):
        kind(**{name: rate})


def test_unknown_field_error_lists_known_fields():
    with pytest.raises(UserError, match=r"unknown deformation field 'voxels'; known are auto, basis, hexplane"):
        ReconstructorConfig(field="voxels")


def test_config_refuses_learning_rates_of_other_field():
    rates = LearningRates(field=HexPlaneLearningRates())
    with pytest.raises(InvalidSetting, match="HexPlaneLearningRates; a basis field has BasisLearningRates"):
        ReconstructorConfig(rates=rates)
    assert ReconstructorConfig(field="hexplane", rates=rates).rates is rates


def test_only_pixel_rates_are_scaled_to_scene():
    rates = BasisLearningRates(means_px=2.0, sh=3.0).scaled(mm_per_px=5.0, scale=0.5)
    assert (rates["means_px"], rates["sh"]) == (5.0, 1.5)


@pytest.mark.parametrize(("field", "chosen"), [("auto", "basis"), ("basis", "basis"), ("hexplane", "hexplane")])
def test_auto_field_is_basis_field(field, chosen):
    assert ReconstructorConfig(field=field).chosen_field == chosen


@pytest.mark.parametrize("field", ["auto", "hexplane"])
def test_offline_config_has_more_gaussians_finer_motion_and_squared_error(field):
    online, offline = ReconstructorConfig(field=field), ReconstructorConfig.offline(field)
    assert offline.field == field
    assert offline.gaussians > online.gaussians
    assert offline.max_gaussians > offline.gaussians
    assert offline.motion_spacing_s < online.motion_spacing_s
    assert offline.squared_error
    assert not online.squared_error


@pytest.mark.parametrize("all_known", [True, False])
@pytest.mark.parametrize("name", DEPTH_ORIGINS)
def test_right_colour_rate_is_full_for_complete_stereo_depth(make_frame, name, all_known):
    frame = make_frame(depth=np.full((40, 48), 60.0, np.float32), depth_origin=DEPTH_ORIGINS[name])
    starts = ReconstructorConfig().starting_from(frame, all_known)
    assert starts.rates.right_share == (1.0 if all_known and name == "stereo" else 0.1)


@pytest.mark.parametrize(
    ("origin", "all_known", "factor"),
    [
        (DEPTH_ORIGINS["measured"], True, 10.0), (DEPTH_ORIGINS["measured"], False, 3.0), (None, True, 10.0), (None, False, 3.0),
        (DEPTH_ORIGINS["stereo"], True, 10.0), (DEPTH_ORIGINS["stereo"], False, 1.0), (DEPTH_ORIGINS["light"], True, 1.0),
        (DEPTH_ORIGINS["learned"], False, 1.0), (DEPTH_ORIGINS["parallax"], True, 1.0),
    ],
)  # fmt: skip
def test_depth_weight_factor_by_origin(make_frame, origin, all_known, factor):
    """Compare with numbers, because a comparison with the table would accept exchanged entries."""
    frame = make_frame(depth=np.full((40, 48), 60.0, np.float32), depth_origin=origin)
    assert ReconstructorConfig(depth_weight=0.1).starting_from(frame, all_known).depth_weight == pytest.approx(
        0.1 * factor
    )


def test_config_is_unchanged_without_depth_or_with_history(make_frame):
    config, deep = ReconstructorConfig(), make_frame(depth=np.full((40, 48), 60.0, np.float32))
    assert config.starting_from(make_frame(), True) is config
    endless = dataclasses.replace(config, history_s=10.0)
    assert endless.starting_from(deep, False) is endless


@pytest.mark.parametrize(
    "settings",
    [
        {"gaussians": 1, "max_gaussians": 1}, {"steps_per_frame": 1}, {"first_frame_steps": 1}, {"window_frames": 1},
        {"sh_degree": 0}, {"sh_degree": 4}, 
        {"ssim_weight": 0.0}, {"ssim_weight": 1.0}, {"depth_weight": 0.0}, {"history_s": 1e-9},
    ],
)  # fmt: skip
def test_config_accepts_boundary_values(settings):
    made = ReconstructorConfig(**settings)
    assert {name: getattr(made, name) for name in settings} == settings


@pytest.mark.parametrize(
    ("name", "value"), [("sh_degree", -1), ("history_s", 0.0), ("history_s", float("inf")),
                        ("default_depth_mm", 0.0), ("motion_spacing_s", float("inf")), ("eyes", "right"), ("motion_detail", "some")],
)  # fmt: skip
def test_config_refuses_values_beyond_limits(name, value):
    with pytest.raises(InvalidSetting, match=name):
        ReconstructorConfig(**{name: value})


def test_config_defaults_equal_published_settings():
    """Figures of `benchmarks/RESULTS.md` and the memory in the docs were taken with these."""
    made = dataclasses.asdict(ReconstructorConfig())
    rates = made.pop("rates")
    assert made == {
        "field": "auto", "gaussians": 30_000, "max_gaussians": 60_000, "sh_degree": 0, "steps_per_frame": 10,
        "first_frame_steps": 60, "window_frames": 30,
        "motion_spacing_s": 0.2, "squared_error": False, "history_s": None, "preallocate": False, "ssim_weight": 0.0,
        "depth_weight": 0.1, "default_depth_mm": 60.0, "eyes": "left", "motion_prior": "bumps", "motion_detail": "full",
        "start_from_motion": False, "depth_from_motion": False, "depth_of_recording": None,
        "losses": (), "renderer": "alpha", "strategy": "streaming",
    }  # fmt: skip
    assert rates == {"means_px": 0.03, "quats": 2e-3, "log_scales": 5e-3, "logit_opacities": 2e-2, "sh": 5e-3,
                     "right_share": 0.1, "field": None}  # fmt: skip
    offline = ReconstructorConfig.offline()
    assert (offline.gaussians, offline.max_gaussians, offline.motion_spacing_s) == (60_000, 80_000, 0.05)
    assert ReconstructorConfig.offline("hexplane").motion_spacing_s == pytest.approx(1 / 15)
    assert offline.depth_of_recording == "parallax"


@pytest.mark.parametrize(
    "name", ["gaussians", "max_gaussians", "steps_per_frame", "first_frame_steps", "window_frames"]
)
@pytest.mark.parametrize("value", [0, -3, 1.5, float("nan"), "7"])
def test_config_counts_must_be_whole_numbers(name, value):
    with pytest.raises(InvalidSetting, match=f"{name} is {value!r}; it must be a whole number of at least 1"):
        ReconstructorConfig(**{name: value})


def test_config_refuses_losses_as_string():
    with pytest.raises(InvalidSetting, match=r"losses is 'flow'; give a list of names, such as \['flow'\]"):
        ReconstructorConfig(losses="flow")
