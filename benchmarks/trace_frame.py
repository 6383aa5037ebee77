"""Modules that a live frame and the creation of a stream pass in the service, with their lines.

    python benchmarks/trace_frame.py [--seconds 5] [--source synthetic:]

A server runs with one stream and one viewer. Every Python process of it records the code objects that are called: first for some seconds of
live frames, where heartbeats and other periodic work are counted, too. Then the stream is stopped, and the control process is recorded while
it is idle and while another stream is created; modules that an idle server calls are left out. A module counts with all of its lines.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service_server import STREAM, Server

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("gsplat_core", "operators", "services")
RECORDER = """
import os, sys, threading, time

folder, called, recording = os.environ["INTRASPLAT_TRACE"], set(), False

def profile(frame, event, argument):
    if recording and event == "call":
        called.add(frame.f_code)

def watch():
    global recording
    written = set()
    while True:
        time.sleep(0.02)
        names = {each for each in os.listdir(folder) if each.endswith(".begin") or each.endswith(".end")}
        for name in sorted(names - written):
            written.add(name)
            if name.endswith(".begin"):
                called.clear()
                recording = True
            else:
                recording = False
                time.sleep(0.2)  # until calls in progress have been added
                path = os.path.join(folder, f"{name[:-4]}.{os.getpid()}")
                with open(path + ".part", "w") as file:
                    file.write("\\n".join(sorted({code.co_filename for code in called})))
                os.replace(path + ".part", path + ".files")

def begin():
    threading.Thread(target=watch, daemon=True).start()
    threading.setprofile(profile)
    sys.setprofile(profile)

os.register_at_fork(after_in_child=begin)
begin()
"""
"""Module that Python imports at the start of every process of the server."""


@contextmanager
def recorded(folder: Path, name: str, pids: list[int], found: dict[int, set[str]]) -> Iterator[None]:
    """Record the modules that processes call inside of the context, by process id."""
    (folder / f"{name}.begin").touch()
    time.sleep(0.1)
    yield
    (folder / f"{name}.end").touch()
    files = [folder / f"{name}.{pid}.files" for pid in pids]
    wait_until_s = time.monotonic() + 30
    while not all(file.exists() for file in files) and time.monotonic() < wait_until_s:
        time.sleep(0.1)
    for file in filter(Path.exists, files):
        modules = {os.path.relpath(line, ROOT) for line in file.read_text().split("\n") if line}
        found[int(file.name.split(".")[1])] = {each for each in modules if each.startswith(PACKAGES)}


def summary(modules: set[str]) -> dict[str, object]:
    """Return the number of modules, their lines, and the lines of each."""
    lines = {each: len((ROOT / each).read_text(encoding="utf-8").splitlines()) for each in sorted(modules)}
    return {"modules": len(lines), "lines": sum(lines.values()), "lines_of": lines}


def main() -> int:
    """Print the modules of both traces as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="duration of the trace of frames")
    parser.add_argument("--source", default="synthetic:", help="source of the stream")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "sitecustomize.py").write_text(RECORDER, encoding="utf-8")
        os.environ["INTRASPLAT_TRACE"] = str(folder)
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
        frame: dict[int, set[str]] = {}
        creation: dict[int, set[str]] = {}
        idle: dict[int, set[str]] = {}
        with Server(options.source) as server:
            server.until(lambda stream: (stream["processes"]["engine"]["figures"] or {}).get("pictures"), 300.0)
            pids = server.pids()
            stop = threading.Event()
            viewer = threading.Thread(target=watch_pictures, args=(server, stop), daemon=True)
            viewer.start()
            time.sleep(3.0)
            with recorded(folder, "frame", list(pids.values()), frame):
                time.sleep(options.seconds)
            stop.set()
            viewer.join(30)
            server.ask(f"/v1/streams/{STREAM}/stop", "POST")
            time.sleep(2.0)
            with recorded(folder, "idle", [pids["control"]], idle):
                time.sleep(2.0)
            with recorded(folder, "creation", [pids["control"]], creation):
                server.ask("/v1/streams", "POST", {"name": "second", "source": options.source, "start": False})
        roles = {role: frame.get(pid, set()) for role, pid in pids.items()}
        missing = [role for role, modules in roles.items() if not modules]
        if missing:
            print(f"no modules were recorded in: {', '.join(missing)}", file=sys.stderr)
            return 1
        report = {
            "frame": summary(set().union(*roles.values())),
            **{f"frame, {role} process": summary(modules) for role, modules in roles.items()},
            "creation of a stream": summary(creation[pids["control"]] - idle[pids["control"]]),
        }
    print(json.dumps(report, indent=1))
    return 0


def watch_pictures(server: Server, stop: threading.Event) -> None:
    """Receive the pictures of the stream in this process until asked to stop."""
    from services.client import Client

    with Client(f"http://127.0.0.1:{server.port}", key=server.key) as client:
        for _ in client.pictures(STREAM):
            if stop.is_set():
                return


if __name__ == "__main__":
    sys.exit(main())
