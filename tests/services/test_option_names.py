"""Registered names are accepted by command line, settings file, REST API and jobs; other names are refused."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
from pydantic import BaseModel, ValidationError

from gsplat_core.choices import DEPTHS, DEPTHS_WITH_ADDRESS, FIELDS, LOSSES, OUTPUTS, RENDERERS, STRATEGIES
from gsplat_core.errors import InvalidSetting
from operators.applications.reconstruct import ReconstructSettings
from operators.options import options_for
from operators.settings import (
    SINKS,
    TOOL_MASKS,
    TOOL_MASKS_WITH_ADDRESS,
    JobOptions,
    LiveOptions,
    ReconstructOptions,
    ReplayOptions,
)
from operators.sources.registry import SOURCES
from services.api import streams
from services.cli import app as command_line
from services.errors import SettingsInvalid
from services.schemas import ReplayRequest, StreamRequest
from services.settings import StreamSettings, load_settings
from services.supervisor.worker import specs_of

NAMES = [
    *(("field", name) for name in FIELDS),
    *(("renderer", name) for name in RENDERERS),
    *(("depth", name) for name in ("auto", *DEPTHS)),
    *(("tool_mask", name) for name in TOOL_MASKS),
    *(("poses", name) for name in ("given", "auto", "estimated")),
    *(("eyes", name) for name in ("left", "both")),
]
KINDS = {"replay": ReplayOptions, "batch": JobOptions, "reconstruct": ReconstructOptions, "live": LiveOptions}


@dataclass
class Network:
    """Path of a network file, for options with an address."""

    path: str

    def of(self, name: str) -> str:
        return f"{name}:{self.path}" if name in DEPTHS_WITH_ADDRESS or name in TOOL_MASKS_WITH_ADDRESS else name


@pytest.fixture
def network(tmp_path):
    (tmp_path / "network.onnx").write_bytes(b"")
    return Network(str(tmp_path / "network.onnx"))


@pytest.fixture
def given(monkeypatch, tmp_path):
    """Return a function that parses a command line and returns the options passed to the command."""

    def parse(command: str, *words: str):
        found = {}

        def keep(*_, **options):
            raise Reached(options)

        class Reached(Exception):
            def __init__(self, options):
                found.update(options)

        monkeypatch.setattr("operators.applications.replay.ReplaySettings", keep)
        monkeypatch.setattr("operators.applications.reconstruct.ReconstructSettings", keep)
        monkeypatch.setattr("services.cli.runs.live_settings", keep)
        monkeypatch.setattr(
            "services.cli.batch.batch_command", lambda folder, out, workers, options, **_: keep(**options)
        )
        where = ["--out", str(tmp_path / "out")] if command in ("replay", "reconstruct") else []
        monkeypatch.setattr(
            command_line, "exit_code_of", lambda error, arguments: 7 if isinstance(error, Reached) else 2
        )
        assert command_line.run([command, "a", *where, *words]) == 7
        return KINDS[command](**{name: found[name] for name in options_for(KINDS[command], command) if name in found})

    return parse


@pytest.mark.parametrize(("option", "name"), NAMES)
def test_registered_names_are_accepted_by_cli_settings_api_and_jobs(option, name, given, network, tmp_path):
    value = network.of(name)
    for command, kind in KINDS.items():
        if option in options_for(kind, command):
            assert getattr(given(command, f"--{option.replace('_', '-')}", value), option) == value
    if option in options_for(JobOptions, "job"):
        wanted = ReplayRequest.model_validate({"recording": "a", "options": {option: value}})
        stored = json.loads(json.dumps(wanted.options.chosen()))
        assert getattr(JobOptions(**stored), option) == value
    file = tmp_path / "settings.yaml"
    file.write_text(json.dumps({"streams": {"a": {"source": "synthetic:", "options": {option: value}}}}))
    listed = load_settings(file).streams["a"]
    asked = StreamRequest.model_validate({"name": "a", "source": "synthetic:", "options": {option: value}})
    for stream in (listed, asked):
        engine = specs_of("a", stream)["engine"].engine
        assert getattr(engine, option) == value


@pytest.mark.parametrize(
    "option", ["field", "renderer", "depth", "tool_mask", "poses", "eyes", "out_of_body", "device"]
)
def test_unknown_names_are_refused_by_cli_settings_and_api(option, tmp_path, capsys):
    flag = f"--{option.replace('_', '-')}"
    for command, kind in KINDS.items():
        if option in options_for(kind, command):
            where = ["--out", str(tmp_path / "out")] if command in ("replay", "reconstruct") else []
            assert command_line.run([command, str(tmp_path), *where, flag, "nope"]) == 2
            assert f"{option} is 'nope'; choose " in capsys.readouterr().err
    with pytest.raises(ValidationError):
        ReplayRequest.model_validate({"recording": "a", "options": {option: "nope"}})
    options = {"streams": {"a": {"source": "synthetic:", "options": {option: "nope"}}}}
    (tmp_path / "settings.yaml").write_text(json.dumps(options))
    with pytest.raises(SettingsInvalid, match=r"line 1: .*(is 'nope'; choose|has no option 'device')"):
        load_settings(tmp_path / "settings.yaml")
    settings = StreamSettings(source="synthetic:").model_copy(update={"options": {option: "nope"}})
    with pytest.raises(InvalidSetting, match=r"nope|has no option 'device'"):
        specs_of("a", settings)


def test_names_registered_at_run_time_are_accepted_and_in_schema():
    RENDERERS.add("dots", "nowhere:Dots")
    try:
        assert ReplayOptions(renderer="dots").renderer == "dots"

        class Wanted(BaseModel):
            options: JobOptions

        assert Wanted.model_json_schema()["$defs"]["JobOptions"]["properties"]["renderer"]["enum"] == [
            "alpha",
            "stochastic",
            "points",
            "weighted_sum",
            "dots",
        ]
    finally:
        RENDERERS.remove("dots")
    with pytest.raises(InvalidSetting, match="renderer is 'dots'; choose alpha"):
        ReplayOptions(renderer="dots")


@pytest.mark.parametrize("value", ["depth", "photometric,depth:0.5", "none"])
def test_losses_with_and_without_weights_are_accepted(value, given):
    losses = () if value == "none" else tuple(value.split(","))
    for command in KINDS:
        assert given(command, "--losses", value).losses == losses
    wanted = ReplayRequest.model_validate({"recording": "a", "options": {"losses": list(losses)}})
    assert wanted.options.losses == losses


@pytest.mark.parametrize("name", LOSSES)
def test_losses_are_accepted_by_cli_api_and_jobs(name, given, tmp_path):
    for command in KINDS:
        assert given(command, "--losses", name).losses == (name,)
    wanted = ReplayRequest.model_validate({"recording": "a", "options": {"losses": [name]}})
    assert JobOptions(**json.loads(json.dumps(wanted.options.chosen()))).losses == (name,)
    for value in (name, [name]):
        asked = StreamRequest.model_validate({"name": "a", "source": "synthetic:", "options": {"losses": value}})
        assert specs_of("a", asked)["engine"].engine.losses == (name,)


RENDERED = [("samples", 3), ("supersampling", 2), ("order", "pixel")]


OF_STILL_MODELS = [("progressive", True), ("storage", "prepared")]


@pytest.mark.parametrize(("option", "value"), [*RENDERED, *OF_STILL_MODELS])
def test_renderer_options_are_accepted_by_cli_api_and_jobs(option, value, given):
    options = {"renderer": "stochastic", option: value}
    if (option, value) in RENDERED:
        for command in KINDS:
            words = [word for name, each in options.items() for word in (f"--{name}", str(each))]
            assert getattr(given(command, *words).renderer_options, option) == value
        wanted = ReplayRequest.model_validate({"recording": "a", "options": options})
        stored = JobOptions(**json.loads(json.dumps(wanted.options.chosen())))
        assert getattr(stored.renderer_options, option) == value
    asked = StreamRequest.model_validate({"name": "a", "source": "synthetic:", "options": options})
    assert getattr(specs_of("a", asked)["engine"].engine.renderer_options, option) == value


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 4}, "choose renderer stochastic or points, or leave samples out"),
        ({"renderer": "points", "order": "pixel"}, "choose renderer stochastic, or leave order out"),
        ({"renderer": "weighted_sum", "losses": ["flow"]}, "choose renderer alpha, or leave the losses flow out"),
    ],
)
def test_incompatible_options_are_refused_with_working_alternative(options, message, tmp_path):
    with pytest.raises(InvalidSetting, match=message):
        ReplayOptions(**options)
    with pytest.raises(ValidationError, match=message):
        ReplayRequest.model_validate({"recording": "a", "options": options})
    with pytest.raises(ValidationError, match=message):
        StreamRequest.model_validate({"name": "a", "source": "synthetic:", "options": options})
    (tmp_path / "settings.yaml").write_text(
        json.dumps({"streams": {"a": {"source": "synthetic:", "options": options}}})
    )
    with pytest.raises(SettingsInvalid, match=message):
        load_settings(tmp_path / "settings.yaml")


@pytest.mark.parametrize(
    ("value", "message"), [("nope", "choose photometric"), ("depth:x", "as in depth:0.1"), ("depth:0", "positive")]
)
def test_unknown_losses_and_weights_are_refused(value, message):
    with pytest.raises(InvalidSetting, match=message):
        ReplayOptions(losses=value)


@pytest.mark.parametrize("name", STRATEGIES)
def test_strategy_option_reaches_reconstructor_config(name, given, tmp_path):
    assert given("reconstruct", "--strategy", name).strategy == name
    settings = ReconstructSettings(tmp_path, tmp_path / "out", strategy=name)
    assert settings.reconstructor_config(offline=True).strategy == name


@pytest.mark.parametrize("name", [*SINKS, ",".join(SINKS), "none"])
def test_sinks_are_accepted_by_runs_and_jobs(name, given):
    sinks = () if name == "none" else tuple(name.split(","))
    for command in ("replay", "batch", "reconstruct"):
        assert given(command, "--sinks", name).sinks == sinks
    for value in (name, list(sinks)):
        wanted = ReplayRequest.model_validate({"recording": "a", "options": {"sinks": value}})
        assert JobOptions(**json.loads(json.dumps(wanted.options.chosen()))).sinks == sinks
    with pytest.raises(InvalidSetting, match="sinks is 'film'; choose video or keyframes"):
        JobOptions(sinks="film")
    with pytest.raises(InvalidSetting, match="sinks is 3; it must be a list of video or keyframes"):
        JobOptions(sinks=3)


def test_every_source_scheme_has_rule():
    """Settings cannot allow a scheme without a rule."""
    known = streams.OF_NETWORKS | streams.OF_FOLDERS | streams.OF_DEVICES | streams.OF_NOTHING
    assert set(SOURCES) == known


@pytest.mark.parametrize(
    "registry", [FIELDS, RENDERERS, LOSSES, OUTPUTS, DEPTHS, TOOL_MASKS, SINKS], ids=lambda each: each.what
)
def test_registry_entries_are_importable(registry):
    for name in registry:
        assert registry[name] is not None
