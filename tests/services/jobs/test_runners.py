"""Attempts as forked processes: environment, end, and reports of the job body."""

from __future__ import annotations

import json
import os
import resource
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
import torch

from gsplat_core.errors import InvalidSetting
from operators.applications.session import Progress
from services.jobs import runners
from services.jobs.pool import new_runner
from services.jobs.results import Task
from services.jobs.runners import Forks
from services.jobs.store import JobProgress, JobState


@pytest.fixture
def forks() -> Iterator[Forks]:
    runner = Forks()
    yield runner
    runner.close()


@pytest.fixture
def body(monkeypatch) -> Callable[[Callable[[Task], None]], None]:
    """Replace the body of jobs in the forked processes."""
    return lambda function: monkeypatch.setattr(runners, "work", function)


def task(folder: Path, name: str = "a", **fields) -> Task:
    (folder / name).mkdir(exist_ok=True)
    return Task(name, str(folder / "recordings" / "one"), str(folder / name), **fields)


def wait_for_ends(forks: Forks, count: int) -> Mapping[str, str]:
    found: dict[str, str] = {}
    deadline = time.monotonic() + 60
    while len(found) < count and time.monotonic() < deadline:
        found |= forks.ended()
        time.sleep(0.01)
    return found


def test_fork_has_own_session_log_and_priority(forks, body, tmp_path):
    def told(task: Task) -> None:
        os.write(1, b"to the log\n")
        os.write(2, b"errors too\n")
        about = {
            "leads": os.getsid(0) == os.getpid(),
            "nice": os.nice(0),
            "core": resource.getrlimit(resource.RLIMIT_CORE),
            "input": os.read(0, 1).decode(),
            "signals": [signal.getsignal(number) == signal.SIG_DFL for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)],
        }  # fmt: skip
        (Path(task.folder) / "about").write_text(json.dumps(about))

    body(told)
    forks.start(task(tmp_path, niceness=3))
    assert wait_for_ends(forks, 1) == {"a": "exit code 0"} and forks.ended() == {}
    about = json.loads((tmp_path / "a" / "about").read_text())
    nice = min(19, os.nice(0) + 3)
    assert about == {"leads": True, "nice": nice, "core": [0, 0], "input": "", "signals": [True] * 3}
    log = tmp_path / "a" / "log"
    assert log.read_text() == "to the log\nerrors too\n" and stat.S_IMODE(log.stat().st_mode) == 0o600


def test_fork_that_raises_exits_1_with_traceback_in_log(forks, body, tmp_path):
    def failing(task: Task) -> None:
        sys.stderr = os.fdopen(2, "w")  # pytest's own goes elsewhere
        raise KeyboardInterrupt("no such thing")

    body(failing)
    forks.start(task(tmp_path))
    assert wait_for_ends(forks, 1) == {"a": "exit code 1"}
    assert "KeyboardInterrupt: no such thing" in (tmp_path / "a" / "log").read_text()


def test_kill_ends_only_named_fork(forks, body, tmp_path):
    def waiting(task: Task) -> None:
        while not (Path(task.folder) / "go").exists():
            time.sleep(0.01)

    body(waiting)
    for name in ("a", "b"):
        forks.start(task(tmp_path, name))
    forks.kill("a")
    forks.kill("nothing")
    assert wait_for_ends(forks, 1) == {"a": "killed by SIGKILL"}
    (tmp_path / "b" / "go").touch()
    assert wait_for_ends(forks, 1) == {"b": "exit code 0"}


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def wait_for_pid(path: Path) -> int:
    """Wait for the process id that an attempt writes, and return it."""
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return int(path.read_text())


def endless(task: Task) -> None:
    part = Path(task.folder) / "part"
    part.write_text(str(os.getpid()))
    part.rename(Path(task.folder) / "pid")
    signal.pause()


def test_close_ends_running_forks(body, tmp_path):
    body(endless)
    forks = Forks()
    forks.start(task(tmp_path))
    pid = wait_for_pid(tmp_path / "a" / "pid")
    assert is_running(pid)
    forks.close()
    assert not is_running(pid)


def test_forks_end_when_pool_process_dies(body, tmp_path):
    body(endless)
    pool = os.fork()
    if pool == 0:
        Forks().start(task(tmp_path))
        signal.pause()
    pid = wait_for_pid(tmp_path / "a" / "pid")
    os.kill(pool, signal.SIGKILL)
    os.waitpid(pool, 0)
    deadline = time.monotonic() + 60
    while is_running(pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not is_running(pid)


FORKED_AFTER_OPENMP = """
import sys, time
from pathlib import Path
import torch
from services.jobs import runners
from services.jobs.results import Task
from services.jobs.runners import Forks

def body(task):
    torch.set_num_threads(2)
    torch.zeros(1 << 20).add_(1)

torch.set_num_threads(2)
torch.zeros(1 << 20).add_(1)  # makes the OpenMP team of this thread
runners.work = body
forks = Forks()
forks.start(Task("a", "recording", sys.argv[1]))
deadline = time.monotonic() + 60
found = {}
while not found and time.monotonic() < deadline:
    found = forks.ended()
    time.sleep(0.01)
forks.close()
print(found)
"""


def test_fork_computes_after_parent_used_openmp_threads(tmp_path):
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    words = [sys.executable, "-c", FORKED_AFTER_OPENMP, str(tmp_path)]
    said = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120, env=environment)
    assert said.stdout.strip() == "{'a': 'exit code 0'}"


@pytest.fixture
def replayed(monkeypatch):
    """Replace the replay and its reports in this process. Return the settings of each replay."""
    seen = []

    def become(run: Callable[[Callable[[Progress], None]], None]) -> list:
        def replay(settings, tell, report):
            seen.append(settings)
            run(tell)

        monkeypatch.setattr("operators.applications.replay.replay", replay)
        monkeypatch.setattr("services.reports.build.require_shown", lambda outcome: None)
        return seen

    threads = torch.get_num_threads()
    yield become
    torch.set_num_threads(threads)


def test_finished_job_reports_last_progress_and_last_known_prediction(replayed, tmp_path):
    def run(tell):
        tell(Progress("replay", 1, 3, psnr_tissue_db=30.0, previous_frame_db=28.0, next_frame_db=27.0))
        tell(Progress("replay", 3, 3, psnr_tissue_db=33.0, previous_frame_db=29.0))

    settings = replayed(run)
    runners.work(job := task(tmp_path, options={"eyes": "both"}, threads=2))
    assert torch.get_num_threads() == 2
    assert (str(settings[0].recording), settings[0].out, settings[0].eyes) == (job.source, job.out, "both")
    assert job.outcome() == (JobState.DONE, None)
    assert job.progress() == JobProgress(3, 3, 33.0, 29.0, 27.0)


def test_work_limits_rate_of_progress_writes(replayed, tmp_path, monkeypatch):
    now, written = [100.0], []
    monkeypatch.setattr(runners.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(Task, "say_progress", lambda self, reached: written.append(reached.frames_done))

    def run(tell):
        for done in range(1, 11):
            tell(Progress("replay", done, 10))
            now[0] += 0.09

    replayed(run)
    runners.work(task(tmp_path))
    assert written == [1, 4, 7, 10]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (InvalidSetting("steps is 0; it must be positive"), "steps is 0; it must be positive"),
        (ValueError("x"), "a bug in this program (ValueError); the log has the rest"),
    ],
)
def test_failed_job_reports_reason_and_logs_error(replayed, tmp_path, capsys, error, reason):
    def run(tell):
        raise error

    replayed(run)
    runners.work(job := task(tmp_path))
    state, said = job.outcome()
    assert state == JobState.FAILED and reason.lower() in said.lower()
    assert type(error).__name__ in capsys.readouterr().err


def test_failure_reason_omits_server_folders(replayed, tmp_path):
    def run(tell):
        raise InvalidSetting(f"{tmp_path}/recordings/one is damaged; upload it again")

    replayed(run)
    runners.work(job := task(tmp_path))
    assert job.outcome() == (JobState.FAILED, "one is damaged; upload it again")


def test_pack_model_replaces_model_folder_by_isplat_file(replayed, tmp_path, monkeypatch):
    def run(tell):
        (job.out / "model").mkdir(parents=True)

    job = task(tmp_path, pack_model=True)
    replayed(run)
    monkeypatch.setattr(runners, "pack", lambda folder, file: file.write_text(folder.name))
    runners.work(job)
    assert [path.name for path in job.out.iterdir()] == ["model.isplat"]
    assert (job.out / "model.isplat").read_text() == "model"


def test_new_runner_uses_ray_only_if_address_is_given(monkeypatch):
    monkeypatch.setattr(runners, "OnRay", lambda address: f"Ray at {address}")
    assert new_runner("head:6379") == "Ray at head:6379"
    loaded = []
    monkeypatch.setattr(runners, "load", lambda: loaded.append(True))
    forks = new_runner(None)
    assert isinstance(forks, Forks) and loaded == [True]
    forks.close()
