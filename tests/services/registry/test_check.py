"""The check of a model in its own process: verdicts, resource limits, isolation."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsplat_core.io import model_files
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.models import TrainedBy
from gsplat_core.rendering.alpha import AlphaRenderer
from gsplat_core.rendering.weighted_sum import WeightedSumRenderer
from services.errors import CheckFailed
from services.registry import check, checking, records
from services.registry.checking import run_check
from services.registry.models import ModelRegistry
from tests.services.registry.made import packed_model, save_model
from tests.services.registry.stub_check import ALWAYS_READY, says


def test_model_limits_match_service_guide():
    guide = (Path(__file__).parents[3] / "docs" / "service.md").read_text(encoding="utf-8").replace("\n", " ")
    stated = (
        f"Limits are {records.MOST_GAUSSIANS:,} Gaussians, {records.MOST_PIXELS:,} pixels, {records.CHECK_S:g} s and"
        f" {records.CHECK_MEMORY_BYTES >> 30} GiB"
    )
    assert stated in guide
    assert records.MOST_UPLOAD_BYTES == records.MOST_TENSOR_BYTES == 4_294_967_296


@pytest.fixture
def checked_words(monkeypatch, capsys):
    """Return the check program's output in this process, without resource limits. Its start takes two seconds."""
    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(check, "keep_files_private", lambda: None)

    def lines(*arguments):
        assert check.main([*map(str, arguments)]) == 0
        return capsys.readouterr().out.splitlines()

    return lines


@pytest.fixture
def checked(checked_words):
    """Return the check program's verdicts in this process."""
    return lambda folder: [json.loads(line) for line in checked_words(folder, "--json")]


@pytest.mark.slow
def test_check_describes_and_renders_valid_model(tmp_path):
    folder = save_model(tmp_path / "model")
    seen = []
    verdict = run_check(folder, validated=lambda description: seen.append(dict(description)))
    assert verdict.reason is None
    (validated,) = seen
    assert validated == {
        "gaussians": 5,
        "parameters": load_bundle(folder).parameter_count,
        "field": "basis",
        "renderer": "alpha",
        "width_px": 16,
        "height_px": 12,
        "time_window_s": [0.0, 1.0],
        "model_sha256": load_bundle(folder).sha256(),
    }
    assert verdict.description.keys() - validated.keys() == {"render_ms", "covered"}


def test_check_renders_model_with_its_own_renderer(checked, tmp_path):
    """A weighted-sum model cannot be rendered by alpha blending."""
    model = load_bundle(save_model(tmp_path / "alpha"))
    gaussians = WeightedSumRenderer.extended(model.gaussians)
    trained_by = TrainedBy("weighted_sum", WeightedSumRenderer.first_values(20.0))
    save_bundle(replace(model, gaussians=gaussians, trained_by=trained_by), tmp_path / "sums")
    validated, ready = checked(tmp_path / "sums")
    assert (validated["renderer"], ready["stage"]) == ("weighted_sum", "ready")


def test_check_without_json_prints_text(checked_words, tmp_path):
    first, second = checked_words(save_model(tmp_path / "model"))
    assert first.startswith("validated: gaussians 5, ") and second.startswith("ready: render_ms ")


@pytest.mark.parametrize(
    ("budget", "most", "reason"),
    [
        ("MOST_GAUSSIANS", 4, "the model has 5 Gaussians; at most 4 are allowed here"),
        ("MOST_TENSOR_BYTES", 100, r"bytes of tensors; at most 100"),
        ("MOST_PIXELS", 191, r"192 pixels \(16x12\); at most 191"),
    ],
)
def test_check_rejects_model_over_limit_before_reading(tmp_path, budget, most, reason, checked, monkeypatch):
    monkeypatch.setattr(check, budget, most)
    (verdict,) = checked(save_model(tmp_path / "model"))
    assert verdict["stage"] == "rejected"
    assert re.search(reason, verdict["reason"])


def test_check_rejects_model_without_gaussians(tmp_path, checked):
    (verdict,) = checked(save_model(tmp_path / "model", count=0))
    assert verdict["stage"] == "rejected" and "no Gaussians" in verdict["reason"]


@pytest.mark.slow
def test_check_rejects_model_over_memory_limit(tmp_path):
    folder = save_model(tmp_path / "model", count=40_000)
    code = "import sys\nfrom services.registry import check, records\nrecords.CHECK_MEMORY_BYTES = 50 << 20\nsys.exit(check.main())"
    verdict = run_check(folder, program=(sys.executable, "-c", code))
    assert verdict.reason is not None and "memory" in verdict.reason


def test_check_gives_no_verdict_if_machine_lacks_memory(tmp_path, monkeypatch, capsys):
    """The check program runs in this process, and the reader finds too little free memory."""
    folder = save_model(tmp_path / "model")
    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    monkeypatch.setattr(model_files, "available_bytes", lambda: 100)
    assert check.main([str(folder), "--json"]) == 1
    said = capsys.readouterr()
    assert said.out == "" and "of memory to load" in said.err


def test_rejection_reason_omits_server_folder(tmp_path, checked):
    folder = save_model(tmp_path / "model")
    (folder / "model.safetensors").write_bytes(b"short")
    (verdict,) = checked(folder)
    assert verdict["stage"] == "rejected" and verdict["reason"].startswith("model.safetensors has")


@pytest.mark.slow
def test_limit_resources_ends_process_over_cpu_time(tmp_path):
    endless = "from services.registry import records\nrecords.CHECK_S = 0.1\nrecords.limit_resources('cpu')\nwhile True: pass\n"
    done = subprocess.run([sys.executable, "-c", endless], capture_output=True)
    assert -done.returncode == signal.SIGXCPU


def test_check_over_time_limit_is_killed_with_child_processes(tmp_path, monkeypatch):
    pid_file = tmp_path / "pid"
    program = says(
        f"import subprocess, sys, time; child = subprocess.Popen(['sleep', '60']); open({str(pid_file)!r}, 'w').write(str(child.pid)); time.sleep(60)"
    )
    for seconds in (1, 10, 100):
        monkeypatch.setattr(checking, "CHECK_PASSED_S", float(seconds))
        with pytest.raises(CheckFailed, match=f"lasted longer than {seconds} s; check again when this machine is less"):
            run_check(tmp_path, program=program)
        if pid_file.exists():  # a busy machine does not start the program within a second
            break
    child = int(pid_file.read_text())
    for _ in range(6_000):
        if not os.path.exists(f"/proc/{child}") or "Z" in Path(f"/proc/{child}/stat").read_text().split():
            break
        threading.Event().wait(0.05)
    else:
        pytest.fail("what the check started still runs")


@pytest.mark.parametrize("name", ["SIGKILL", "SIGSEGV", "SIGXCPU"])
def test_model_is_rejected_if_check_dies_by_signal(tmp_path, name):
    program = says(f"import os, signal; os.kill(os.getpid(), signal.{name})")
    assert f"was ended by {name}" in run_check(tmp_path, program=program).reason


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (says("import sys; sys.exit('the core is missing')"), "code 1 and without a verdict: the core is missing"),
        (says("print('hello')"), "code 0 and without a verdict: it said nothing"),
        (says("import os, signal; os.kill(os.getpid(), signal.SIGTERM)"), "code -15"),
        (says("""print('{"stage": "ready"}'); raise SystemExit(3)"""), "code 3"),
        (("/nowhere/python",), "cannot be started: No such file"),
    ],
)
def test_run_check_raises_if_program_gives_no_verdict(tmp_path, program, said):
    with pytest.raises(CheckFailed, match=said):
        run_check(tmp_path, program=program)


def test_version_can_be_checked_again_after_check_failed(tmp_path, files):
    with ModelRegistry(tmp_path, check_program=says("raise SystemExit(1)")) as registry:
        registry.upload("liver", packed_model(files), None, "surgeon")
        with pytest.raises(CheckFailed):
            registry.check("liver", 1)
        assert registry.version("liver", 1).state == "uploaded"
    with ModelRegistry(tmp_path, check_program=ALWAYS_READY) as registry:
        assert registry.recover().unchecked == (("liver", 1),)
        assert registry.check("liver", 1).state == "ready"


def test_closing_registry_ends_running_and_waiting_checks(tmp_path, files):
    """One check runs and another waits for it. Neither version is rejected."""
    begun = tmp_path / "begun"
    program = says(f"import time; open({str(begun)!r}, 'w').close(); time.sleep(60)")
    registry = ModelRegistry(tmp_path / "registry", check_program=program)
    for _ in range(2):
        registry.upload("liver", packed_model(files), None, "surgeon")
    with ThreadPoolExecutor(2) as pool:
        checks = [pool.submit(registry.check, "liver", version) for version in (1, 2)]
        while not begun.exists():
            assert not any(check.done() for check in checks)
            threading.Event().wait(0.01)
        registry.close()
        for check in checks:
            with pytest.raises(CheckFailed, match="because the service stops"):
                check.result(60)
    with ModelRegistry(tmp_path / "registry", check_program=ALWAYS_READY) as again:
        assert again.recover().unchecked == (("liver", 1), ("liver", 2))
    registry.close()


def test_check_environment_contains_no_credentials(tmp_path, monkeypatch):
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    program = says("import json, os; print(json.dumps({'stage': 'rejected', 'reason': ' '.join(os.environ)}))")
    monkeypatch.setenv("INTRASPLAT_KEY_FILE", "key")
    # The instruction set of the machine is no credential, and the check follows it.
    names = set(run_check(tmp_path, program=program).reason.split()) - {"INTRASPLAT_ISA"}
    assert "PATH" in names and not any("AWS" in name or "INTRASPLAT_" in name for name in names)


def test_run_check_survives_output_flood(tmp_path):
    program = says(
        "import sys\nfor _ in range(100_000): sys.stdout.write('x' * 100)\nprint('\\n{\"stage\": \"ready\"}')"
    )
    assert run_check(tmp_path, program=program).reason is None


def test_check_rejects_model_with_non_finite_render(tmp_path, monkeypatch, capsys):
    """The check program runs in this process with a broken renderer."""
    folder = save_model(tmp_path / "model")
    monkeypatch.setattr(check, "limit_resources", lambda device: None)
    render = AlphaRenderer.render

    def broken(self, camera, time_s, *arguments):
        frame = render(self, camera, time_s, *arguments)
        output = frame.result()
        if time_s == 0.5:
            output.image[3, 4, 1] = torch.nan
        return frame

    monkeypatch.setattr(AlphaRenderer, "render", broken)
    assert check.main([str(folder), "--json"]) == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert last == {
        "stage": "rejected",
        "reason": "the picture at 0.5 s has 1 values of its image that are NaN or infinite",
    }
