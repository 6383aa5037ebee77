"""Real `intrasplat serve` for measurements: started with a stream, called over HTTP, observed through /proc."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

STREAM = "bench"
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
UNLIMITED = {"requests_per_s": 1e6, "address_requests_per_s": 1e6}


class Server:
    """Server with one stream in a temporary folder. Use as a context manager."""

    def __init__(
        self,
        source: str,
        *,
        device: str = "cpu",
        show: str = "live",
        options: Mapping[str, Any] | None = None,
        sections: Mapping[str, Any] | None = None,
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="isp-")
        self.path = Path(self._folder.name)
        self._config = self.path / "service.json"  # JSON is YAML
        stream = {"source": source, "device": device, "show": show, "options": dict(options or {})}
        settings = {
            "server": {"port": 0},
            "paths": {"data": str(self.path / "data"), "runtime": str(self.path / "run")},
            "limits": UNLIMITED,
            "log": {"level": "warning", "format": "text"},
            "streams": {STREAM: stream},
            **(sections or {}),
        }
        self._config.write_text(json.dumps(settings))
        self.process: subprocess.Popen | None = None
        self.port = 0

    @property
    def data(self) -> Path:
        """Return the service's data folder."""
        return self.path / "data"

    @property
    def runtime(self) -> Path:
        """Return the folder of the service's sockets."""
        return self.path / "run"

    @property
    def key(self) -> str:
        """Return the administrator's key."""
        return (self.data / "admin.key").read_text().strip()

    def start(self) -> float:
        """Start the control plane, and return the seconds until the API answers."""
        began_s = time.monotonic()
        log = self.path / "serve.log"
        before = log.stat().st_size if log.exists() else 0
        with open(log, "ab") as output:
            command = [sys.executable, "-m", "services.cli", "serve", "--config", str(self._config)]
            self.process = subprocess.Popen(
                command, stderr=output, stdout=output, env={**os.environ, "PYTHONPATH": _paths()}
            )
        pattern = re.compile(r"IntraSplat is on http://127\.0\.0\.1:(\d+)/")
        while not (found := pattern.search(log.read_text(errors="replace")[before:])):
            if self.process.poll() is not None or time.monotonic() - began_s > 60:
                raise RuntimeError(f"the server did not start: {log.read_text(errors='replace')[-2000:]}")
            time.sleep(0.01)
        self.port = int(found[1])
        return time.monotonic() - began_s

    def ask(self, path: str, method: str = "GET", body: Any = None, headers: Mapping[str, str] | None = None) -> Any:
        """Call the API and return the answer. Raises RuntimeError unless the call succeeds."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            sent = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
            said = {"Authorization": f"Bearer {self.key}", "Content-Type": "application/json", **(headers or {})}
            connection.request(method, path, sent, said)
            answer = connection.getresponse()
            content = answer.read()
        finally:
            connection.close()
        if answer.status >= 300:
            raise RuntimeError(f"{method} {path}: {answer.status} {content[:400]!r}")
        return json.loads(content) if "json" in answer.headers.get("Content-Type", "") else content.decode()

    def stream(self) -> dict[str, Any]:
        """Return the stream's state from the API."""
        return self.ask(f"/v1/streams/{STREAM}")

    def until(self, what: Callable[[dict[str, Any]], Any], within_s: float = 120.0) -> float:
        """Wait until the stream fulfils a condition, and return the seconds."""
        began_s = time.monotonic()
        while True:
            found = self.stream()
            if what(found):
                return time.monotonic() - began_s
            if time.monotonic() - began_s > within_s:
                raise TimeoutError(f"the stream is {found}\n{self.logs()}")
            time.sleep(0.05)

    def until_live(self) -> float:
        """Wait until pictures are shown as live, and return the seconds."""
        return self.until(lambda stream: stream["state"] == "live")

    def pids(self) -> dict[str, int]:
        """Return the process ids by role."""
        assert self.process is not None
        processes = self.stream()["processes"]
        return {"control": self.process.pid, **{role: processes[role]["pid"] for role in ("capture", "engine")}}

    def ticket(self) -> str:
        """Return a ticket for one display connection."""
        return self.ask("/v1/tickets", "POST", {"path": f"/v1/streams/{STREAM}/display"})["ticket"]

    def kill(self) -> None:
        """Kill the control plane by SIGKILL."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def logs(self) -> str:
        """Return the last lines of all process logs."""
        files = [self.path / "serve.log", *(self.runtime / STREAM).glob("*.log")]
        return "\n".join(f"{file.name}: {file.read_text(errors='replace')[-1500:]}" for file in files if file.exists())

    def __enter__(self) -> Server:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(30)
        self._folder.cleanup()


def cpu_s(pid: int) -> float:
    """Return the user and system time of a process with all its threads, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def machine_busy_s() -> float:
    """Return the busy time of all cores, for all processes of the machine."""
    user, nice, system, _, _, irq, softirq, *_ = map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:])
    return (user + nice + system + irq + softirq) / TICKS_PER_S


def resident_mib(pid: int) -> float:
    """Return the private anonymous memory of a process in MiB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return round(int(line.split()[1]) / 1024, 1)
    raise RuntimeError(f"/proc/{pid}/status has no RssAnon")


def _paths() -> str:
    root = str(Path(__file__).resolve().parents[1])
    return os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
