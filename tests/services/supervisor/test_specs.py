"""Specifications of stream processes, and the assignment of GPUs."""

from __future__ import annotations

import re
import stat
from dataclasses import asdict

import pytest
from pydantic import ValidationError

from gsplat_core.errors import InvalidSetting
from services.bus.runtime import ProcessIdentity, write_json
from services.settings import NAME_PATTERN
from services.supervisor.worker import EngineSpec, ProcessLimits, ProcessSpec, SourceSpec, assigned


def spec(**changes) -> ProcessSpec:
    return ProcessSpec(**{"stream": "a", "capture": SourceSpec(address="synthetic:"), **changes})


def test_process_spec_round_trips_through_private_file(runtime):
    wanted = ProcessSpec(stream="a", engine=EngineSpec(device="cuda", gpu=3))
    path = wanted.write(runtime.stream("a"))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    read = ProcessSpec.read(path, "engine")
    assert (read.engine, read.digest, read.role) == (wanted.engine, wanted.digest, "engine")
    assert read.supervisor == asdict(ProcessIdentity.own())


def test_process_spec_digest_changes_with_settings():
    changed = spec(capture=SourceSpec(address="synthetic:", fps=5.0)), spec(limits=ProcessLimits(drain_s=1.0))
    assert spec().digest == spec().digest
    assert len({each.digest for each in (spec(), *changed, spec(stream="b"))}) == 4


def test_process_spec_takes_every_stream_name_of_the_settings():
    longest = "x" * 40
    assert re.match(NAME_PATTERN, longest) and not re.match(NAME_PATTERN, longest + "x")
    assert spec(stream=longest).stream == longest


@pytest.mark.parametrize("name", ["", "A", "../x", "a/b", ".", "-a", "x" * 41, "a\n", "ä"])
def test_process_spec_rejects_invalid_stream_names(name):
    with pytest.raises(ValidationError):
        spec(stream=name)


@pytest.mark.parametrize("parts", [{"capture": None}, {"engine": EngineSpec()}])
def test_process_spec_requires_either_capture_or_engine(parts):
    with pytest.raises(ValidationError, match="either capture or engine"):
        spec(**parts)


@pytest.mark.parametrize(
    "wrong", [{"scale": 0}, {"scale": float("nan")}, {"fps": -1}, {"address": ""}, {"adress": "x"}], ids=str
)
def test_source_spec_rejects_invalid_values(wrong):
    with pytest.raises((InvalidSetting, TypeError)):
        SourceSpec(**{"address": "synthetic:", **wrong})


def test_process_spec_read_raises_for_missing_damaged_or_wrong_file(runtime):
    with pytest.raises(InvalidSetting, match="cannot be read"):
        ProcessSpec.read(runtime.path / "none", "capture")
    path = runtime.path / "wrong"
    write_json(path, {"stream": "a", "capture": {"address": "x", "scale": 9}})
    with pytest.raises(InvalidSetting, match=r"capture\.scale"):
        ProcessSpec.read(path, "capture")
    path.write_text("{")
    with pytest.raises(InvalidSetting, match="is damaged"):
        ProcessSpec.read(path, "capture")
    with pytest.raises(InvalidSetting, match="is for the capture process, and this is the engine process"):
        ProcessSpec.read(spec().write(runtime.stream("a")), "engine")


def test_assigned_spreads_engines_over_gpus():
    cuda, fixed, cpu = EngineSpec(device="cuda"), EngineSpec(device="cuda", gpu=0), EngineSpec()
    placed: list[EngineSpec] = []
    for engine in (cpu, fixed, cuda, cuda, cuda):
        placed.append(assigned(engine, placed, 2))
    assert [each.gpu for each in placed] == [None, 0, 1, 0, 1]
    assert assigned(cuda, placed, 0) == cuda


def test_source_spec_error_omits_rejected_address():
    with pytest.raises(InvalidSetting, match=r"^address is not valid; ") as refused:
        SourceSpec(address="rtsp://user:swordfish@camera/" + 5000 * "x")
    assert "swordfish" not in str(refused.value)
