"""Resource limits, exit codes and verdicts of the programs that check and convert uploads."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import Any

import pytest
import torch

from gsplat_core.errors import BundleCorrupt, BundleError
from services.registry import check, records
from services.registry.records import limit_resources, says_out_of_memory

FREE = resource.RLIM_INFINITY


class Limits:
    """Records resource limits instead of setting them."""

    def __init__(self, patch: pytest.MonkeyPatch, hard: dict[int, int]) -> None:
        self.set: dict[int, tuple[int, int]] = {}
        self.nice: list[int] = []
        patch.setattr(records.os, "nice", self.nice.append)
        patch.setattr(resource, "getrlimit", lambda kind: (FREE, hard.get(kind, FREE)))
        patch.setattr(resource, "setrlimit", self.set.__setitem__)
        patch.setattr(records, "taken_bytes", lambda: 1000)
        patch.setattr(records.time, "process_time", lambda: 2.5)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_limit_resources_adds_limits_to_resources_in_use(monkeypatch: pytest.MonkeyPatch, device: str) -> None:
    limits = Limits(monkeypatch, {})
    limit_resources(device)
    assert limits.nice == [records.NICENESS] and limits.set[resource.RLIMIT_CORE] == (0, 0)
    seconds = int(records.CHECK_S) + 3
    assert limits.set[resource.RLIMIT_CPU] == (seconds, seconds + 5), "SIGXCPU comes before SIGKILL"
    most = records.CHECK_MEMORY_BYTES + 1000
    assert limits.set.get(resource.RLIMIT_DATA) == ((most, most) if device == "cpu" else None)


def test_limit_resources_keeps_lower_hard_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = Limits(monkeypatch, {resource.RLIMIT_CPU: 60, resource.RLIMIT_DATA: records.CHECK_MEMORY_BYTES + 1001})
    limit_resources("cpu")
    assert limits.set[resource.RLIMIT_CPU] == (60, 60)
    assert limits.set[resource.RLIMIT_DATA] == (records.CHECK_MEMORY_BYTES + 1000,) * 2


def test_taken_bytes_counts_allocated_memory() -> None:
    before = records.taken_bytes()
    kept = bytearray(64 << 20)
    assert 60 << 20 < records.taken_bytes() - before < 80 << 20
    del kept


@pytest.mark.parametrize(
    ("error", "says_so"),
    [
        (MemoryError(), True), (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried"), True),
        (RuntimeError("CUDA out of memory"), True), (RuntimeError("std::bad_alloc"), True), (RuntimeError("shapes differ"), False),
    ],
    ids=str,
)  # fmt: skip
def test_says_out_of_memory_recognises_memory_errors(error: Exception, says_so: bool) -> None:
    assert says_out_of_memory(error) == says_so


FAILURES = [
    (BundleCorrupt("{folder}/scene.bin is torn"), 0, "rejected", "scene.bin is torn"),
    (BundleError("{folder}/scene.bin cannot be read"), 1, None, "cannot be read"),
    (MemoryError(), 0, "rejected", "it needs more memory than the"),
    (RuntimeError("std::bad_alloc"), 0, "rejected", "it needs more memory than the"),
]


@pytest.mark.parametrize(("error", "code", "stage", "said"), FAILURES, ids=lambda each: type(each).__name__)
@pytest.mark.parametrize("program", ["check", "convert"])
def test_check_and_convert_reject_only_for_file_errors(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, program: str, error: Exception,
    code: int, stage: str | None, said: str,
) -> None:  # fmt: skip
    raised = type(error)(*(str(each).format(folder=tmp_path) for each in error.args))

    def fail(*_: Any) -> None:
        raise raised

    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "_read", fail)
    monkeypatch.setattr(check, "convert", fail)
    arguments = [str(tmp_path)] if program == "check" else [str(tmp_path / "scene.ply"), str(tmp_path / "target")]
    found = check.main([*arguments, "--json"])
    out, err = capsys.readouterr()
    assert found == code and said in (out + err) and str(tmp_path) not in out
    assert (json.loads(out)["stage"] if out else None) == stage


@pytest.mark.parametrize("program", ["check", "convert"])
def test_check_and_convert_raise_other_errors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, program: str) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("shapes differ")

    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "_read", fail)
    monkeypatch.setattr(check, "convert", fail)
    arguments = [str(tmp_path)] if program == "check" else [str(tmp_path / "a"), str(tmp_path / "b")]
    with pytest.raises(RuntimeError, match="shapes differ"):
        check.main([*arguments, "--json"])


def test_check_gives_no_verdict_if_gpu_is_out_of_memory(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fail(*_: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nmore lines")

    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "_read", fail)
    assert check.main([str(tmp_path), "--json"]) == 1
    assert capsys.readouterr() == ("", "CUDA out of memory.\n")


@pytest.mark.parametrize(("values", "kind"), [(True, BundleCorrupt), (False, BundleError)])
def test_convert_raises_bundle_corrupt_for_invalid_values_and_counts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, values: bool, kind: type[Exception]
) -> None:
    class Model:
        class gaussians:
            count, sh_degree = 5, 0

    def save(model: Any, folder: Path) -> None:
        raise BundleError("not saved") from (BundleCorrupt("a scale is infinite") if values else OSError("full"))

    monkeypatch.setattr(check, "load_model", lambda file: Model)
    monkeypatch.setattr(check, "save_bundle", save)
    with pytest.raises(kind, match="a scale is infinite" if values else "not saved") as raised:
        check.convert(tmp_path / "scene.ply", tmp_path / "target")
    assert type(raised.value) is kind
    monkeypatch.setattr(check, "save_bundle", lambda model, folder: None)
    monkeypatch.setattr(check, "pack", lambda folder, target: None)
    assert check.convert(tmp_path / "scene.ply", tmp_path / "target") == {"gaussians": 5, "sh_degree": 0}
    for most, is_refused in ((5, False), (4, True)):
        monkeypatch.setattr(check, "MOST_GAUSSIANS", most)
        if is_refused:
            with pytest.raises(BundleCorrupt, match="has 5 Gaussians; at most 4"):
                check.convert(tmp_path / "scene.ply", tmp_path / "target")
        else:
            check.convert(tmp_path / "scene.ply", tmp_path / "target")
