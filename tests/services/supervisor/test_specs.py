from __future__ import annotations

import stat

import pytest
from pydantic import ValidationError

from gsplat_core.errors import InvalidSetting
from services.bus.runtime import write_json
from services.supervisor.specs import EngineSpec, ProcessSpec, SourceSpec, StreamSpec, assigned


def spec(**changes) -> StreamSpec:
    return StreamSpec(**{"name": "a", "source": SourceSpec(address="synthetic:"), **changes})


def test_a_process_reads_its_part(runtime):
    folder = runtime.stream("a")
    wanted = spec(engine=EngineSpec(device="cuda", gpu=3))
    path = wanted.write("engine", folder)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    read = ProcessSpec.read(path)
    assert (read.engine, read.capture, read.digest) == (wanted.engine, None, wanted.digest("engine"))
    assert b"synthetic" not in path.read_bytes()


def test_the_digest_changes_with_the_part_alone():
    one, other = spec(), spec(engine=EngineSpec(seed=1))
    assert one.digest("capture") == other.digest("capture")
    assert one.digest("engine") != other.digest("engine")
    assert one.digest("capture") != one.digest("engine")


@pytest.mark.parametrize("name", ["", "A", "../x", "a/b", ".", "-a", "x" * 33, "a\n", "ä"])
def test_names_that_are_no_names(name):
    with pytest.raises(ValidationError):
        spec(name=name)


@pytest.mark.parametrize(
    "wrong", [{"scale": 0}, {"scale": float("nan")}, {"fps": -1}, {"address": ""}, {"adress": "x"}], ids=str
)
def test_sources_that_are_none(wrong):
    with pytest.raises((InvalidSetting, TypeError)):
        SourceSpec(**{"address": "synthetic:", **wrong})


def test_a_file_that_is_none_is_refused_in_one_sentence(runtime):
    with pytest.raises(InvalidSetting, match="cannot be read"):
        ProcessSpec.read(runtime.path / "none")
    path = runtime.path / "wrong"
    write_json(path, {**spec().part("capture"), "digest": "", "capture": {"address": "x", "scale": 9}})
    with pytest.raises(InvalidSetting, match=r"capture\.scale"):
        ProcessSpec.read(path)


def test_streams_are_spread_over_gpus():
    cuda, fixed, cpu = EngineSpec(device="cuda"), EngineSpec(device="cuda", gpu=0), EngineSpec()
    streams = [spec(engine=engine) for engine in (cuda, cpu, fixed, cuda, cuda)]
    assert [each.engine.gpu for each in assigned(streams, 2)] == [1, None, 0, 0, 1]
    assert assigned(streams, 0) == streams


def test_an_address_that_is_refused_is_not_repeated():
    with pytest.raises(InvalidSetting, match=r"^address is not valid; ") as refused:
        SourceSpec(address="rtsp://user:swordfish@camera/" + 5000 * "x")
    assert "swordfish" not in str(refused.value)


def test_a_file_of_an_earlier_version_loads(runtime):
    engine = {
        "device": "cuda", "gpu": 1, "engine_scale": None, "field": "auto", "renderer": "alpha", "seed": 7, "budget_ms": 20.0,
        "tool_mask": "none", "depth": "stereo", "eyes": "left", "poses": "given", "out_of_body": "off",
    }  # fmt: skip
    capture = {"address": "synthetic:", "scale": 0.5, "fps": None, "loop": True}
    for role, part in (("engine", engine), ("capture", capture)):
        path = runtime.path / role
        write_json(path, {**spec().part(role), "digest": "", role: part})
        read = getattr(ProcessSpec.read(path), role)
        assert {name: getattr(read, name) for name in part} == part
