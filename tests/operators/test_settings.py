"""Declarations of the engine's options, and what is derived from them."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

from gsplat_core.errors import InvalidSetting
from operators.applications.live_settings import LiveSettings
from operators.applications.replay import ReplaySettings
from operators.options import Command, options_of
from operators.settings import (
    CallerCaptureOptions,
    CallerEngineOptions,
    CallerJobOptions,
    JobOptions,
    LiveOptions,
    ReconstructOptions,
    ReplayOptions,
    check_stream_options,
    stream_options_schema,
)

ROOT = Path(__file__).resolve().parents[2]
KINDS = (ReplayOptions, ReconstructOptions, LiveOptions, CallerJobOptions, CallerCaptureOptions, CallerEngineOptions)
EVERY = {name: each for kind in KINDS for name, each in options_of(kind).items()}
WRONG = {float: (True, "1", "nan", float("nan"), float("inf"), [], {}), int: (True, 1.0, "1", float("nan")), bool: (0, 1, "yes"), str: (1, True, b"x", "")}  # fmt: skip


@pytest.mark.parametrize("name", EVERY)
def test_option_description_is_one_phrase_and_default_is_valid(name):
    each = EVERY[name]
    assert each.option.description[0].isupper() and not each.option.description.endswith(".")
    assert set(each.option.commands) <= set(get_args(Command)) and each.option.commands
    assert each.checked(each.default) == each.default
    assert each.default is not None or each.option.null, "the meaning of no value is stated"


@pytest.mark.parametrize("name", EVERY)
def test_option_refuses_values_of_other_type(name):
    each = EVERY[name]
    for value in WRONG.get(each.plain, ()):
        if each.kind is tuple or (isinstance(each.default, tuple) and value == ""):
            continue
        with pytest.raises(InvalidSetting, match=rf"^{name} is .*; (it|choose|nothing) "):
            each.checked(value)
    with pytest.raises(InvalidSetting, match=f"^{name} is "):
        each.checked(object())


@pytest.mark.parametrize("name", [name for name, each in EVERY.items() if each.plain in (int, float)])
def test_option_error_states_range_beyond_limits(name):
    each = EVERY[name]
    schema = TypeAdapter(each.hint).json_schema()
    (limits,) = [kind for kind in schema.get("anyOf", [schema]) if kind["type"] != "null"]
    for key, beyond in (("minimum", -1), ("exclusiveMinimum", 0), ("maximum", 1), ("exclusiveMaximum", 0)):
        if key in limits:
            with pytest.raises(InvalidSetting, match=re.escape(each.option.range)):
                each.checked(each.plain(limits[key]) + beyond)
    for key in ("minimum", "maximum"):
        if key in limits:
            assert each.checked(each.plain(limits[key])) == limits[key]


@pytest.mark.parametrize(
    ("kind", "arguments"), [(ReplaySettings, ("a", Path("out"))), (LiveSettings, ("a", Path("out")))]
)
def test_run_settings_have_options_and_validate(kind, arguments):
    settings = kind(*arguments, eyes="both", scale=2, seed=3)
    assert (settings.eyes, settings.given_scale, settings.seed) == ("both", 2.0, 3)
    assert settings.reconstructor_config(10_000).eyes == "both"
    assert kind(*arguments).reconstructor_config(10_000).eyes == "left"
    with pytest.raises(InvalidSetting, match="seed is -1; it must be from 0 to"):
        dataclasses.replace(settings, seed=-1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.seed = 4


def test_caller_job_options_have_lower_limits():
    assert JobOptions(seed=2**40, steps_per_frame=20_000, scale=8).seed == 2**40
    for name, value in (("seed", 2**40), ("steps_per_frame", 20_000), ("scale", 8)):
        with pytest.raises(InvalidSetting, match=f"{name} is {value}"):
            CallerJobOptions(**{name: value})


def test_chosen_returns_non_default_options_as_json():
    assert JobOptions().chosen() == {}
    chosen = JobOptions(seed=0, scale=0.5, sinks=("video",)).chosen()
    assert chosen == {"scale": 0.5, "sinks": ["video"]}
    assert JobOptions(**chosen) == JobOptions(scale=0.5, sinks=("video",))


@pytest.mark.parametrize(
    "stored",
    [
        {},
        {"steps_per_frame": 2, "heldout": True},
        {"device": "cuda", "field": "hexplane", "renderer": "alpha", "seed": 2147483647, "max_frames": 10_000_000},
        {"depth": "parallax", "poses": "estimated", "eyes": "left", "scale": 0.25, "ignore_schedule": True},
        {"eyes": None, "steps_per_frame": None},
    ],
)
def test_options_of_jobs_stored_by_earlier_versions_load(stored):
    settings = ReplaySettings(recording=Path("a"), out=Path("out"), **stored)
    assert {name: getattr(settings, name) for name in stored} == stored


def test_caller_job_options_validate_as_pydantic_model():
    class Wanted(BaseModel):
        options: CallerJobOptions = CallerJobOptions()

    assert Wanted.model_validate({"options": {"poses": "estimated"}}).options == CallerJobOptions(poses="estimated")
    for wrong in ({"seed": True}, {"engine": "holoscan"}, {"x": 1}, {"heldout": 1}, {"scale": "1"}):
        with pytest.raises(ValidationError) as refused:
            Wanted.model_validate({"options": wrong})
        assert refused.value.errors()[0]["loc"] == ("options", *wrong)


def test_check_stream_options_accepts_defaults_and_null():
    for name, schema in stream_options_schema()["properties"].items():
        check_stream_options({name: None})
        check_stream_options({name: schema["default"]})
    with pytest.raises(InvalidSetting, match="a stream has no option 'sead'; the nearest is 'seed'"):
        check_stream_options({"sead": 1})


def test_importing_operators_settings_loads_no_heavy_module():
    code = "import sys, operators.settings; print({'torch', 'cv2', 'numpy', 'pydantic'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "set()\n"
