"""Server processes for tests that use them as a client."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = """
server: {{port: 0}}
paths: {{data: {folder}/data, runtime: {folder}/r}}
log: {{format: text}}
limits: {{requests_per_s: 100000, address_requests_per_s: 100000}}
streams: {{theatre-1: {{source: "synthetic:?width=64&height=48&frames=4&fps=2", device: cpu, start: false}}}}
"""


@contextmanager
def serving(folder: Path) -> Iterator[tuple[str, str]]:
    """Run a server with a stopped stream. Yield its URL and admin key. Check for a clean exit without traceback."""
    settings = folder / "settings.yaml"
    settings.write_text(SETTINGS.format(folder=folder))
    log = folder / "log"
    with log.open("w") as output:
        command = [sys.executable, "-m", "services.cli", "serve", "--config", settings]
        process = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output)
    try:
        end_s = time.monotonic() + 300
        while not (found := re.search(r"IntraSplat is on (http://[^/\s]+)", log.read_text())):
            assert time.monotonic() < end_s and process.poll() is None, log.read_text()
            time.sleep(0.05)
        yield found[1], (folder / "data" / "admin.key").read_text().strip()
        process.terminate()
        assert process.wait(300) == 0, log.read_text()[-4000:]
        assert "Traceback" not in log.read_text(), log.read_text()
    finally:
        process.kill()
        process.wait()
