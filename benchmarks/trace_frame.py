"""Modules that a live frame and the creation of a stream pass in the service, with their lines.

    python benchmarks/trace_frame.py [--seconds 5] [--source synthetic:]

A server runs with one stream and one viewer. Every Python process of it counts the calls of code objects: first for some seconds of live
frames. Then the stream is stopped, and the control process is recorded while it is idle and while another stream is created; modules that an
idle server calls are left out.

`frame` has all modules that are called, also for heartbeats and other work at intervals; `every frame` those with a function that is called at
least half as often as a picture is displayed. `lines` counts all lines of a module, `called_lines` those of the functions that were called,
with their docstrings.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from service_server import STREAM, Server

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("gsplat_core", "operators", "services")
RECORDER = """
import os, sys, threading, time

folder, called, recording = os.environ["INTRASPLAT_TRACE"], {}, False

def profile(frame, event, argument):
    if recording and event == "call":
        called[frame.f_code] = called.get(frame.f_code, 0) + 1

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
                    for code, calls in list(called.items()):
                        file.write(f"{code.co_filename}:{code.co_firstlineno}:{calls}\\n")
                os.replace(path + ".part", path + ".files")

def begin():
    threading.Thread(target=watch, daemon=True).start()
    threading.setprofile(profile)
    sys.setprofile(profile)

os.register_at_fork(after_in_child=begin)
begin()
"""
"""Module that Python imports at the start of every process of the server."""


Called = dict[str, dict[int, int]]
"""Path of a module, relative to the root, to the numbers of calls of its functions, by their first lines."""


@contextmanager
def recorded(folder: Path, name: str, pids: list[int], found: dict[int, Called]) -> Iterator[None]:
    """Record the functions that processes call inside of the context, by process id."""
    (folder / f"{name}.begin").touch()
    time.sleep(0.1)
    yield
    (folder / f"{name}.end").touch()
    files = [folder / f"{name}.{pid}.files" for pid in pids]
    wait_until_s = time.monotonic() + 30
    while not all(file.exists() for file in files) and time.monotonic() < wait_until_s:
        time.sleep(0.1)
    for file in filter(Path.exists, files):
        called: Called = {}
        for line in filter(None, file.read_text().split("\n")):
            path, first, calls = line.rsplit(":", 2)
            module = os.path.relpath(path, ROOT)
            if module.startswith(PACKAGES):
                functions = called.setdefault(module, {})
                functions[int(first)] = functions.get(int(first), 0) + int(calls)
        found[int(file.name.split(".")[1])] = called


def often(trace: Called, least_calls: float) -> Called:
    """Return the functions that were called so many times or more."""
    kept = {
        module: {first: calls for first, calls in functions.items() if calls >= least_calls}
        for module, functions in trace.items()
    }
    return {module: functions for module, functions in kept.items() if functions}


def called_lines(source: str, first_lines: Collection[int]) -> int:
    """Return the number of lines of the functions that begin at these lines, with decorators."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            first = min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", ()))])
            if first in first_lines:
                lines.update(range(first, (node.end_lineno or first) + 1))
    return len(lines)


def summary(*traces: Called) -> dict[str, object]:
    """Return the number of modules, their lines, those of called functions, and the lines of each module."""
    together: Called = {}
    for trace in traces:
        for module, functions in trace.items():
            together.setdefault(module, {}).update(functions)
    sources = {module: (ROOT / module).read_text(encoding="utf-8") for module in sorted(together)}
    lines = {module: len(source.splitlines()) for module, source in sources.items()}
    called = sum(called_lines(source, together[module]) for module, source in sources.items())
    return {"modules": len(lines), "lines": sum(lines.values()), "called_lines": called, "lines_of": lines}


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
        frame: dict[int, Called] = {}
        creation: dict[int, Called] = {}
        idle: dict[int, Called] = {}
        with Server(options.source) as server:
            server.until(lambda stream: (stream["processes"]["engine"]["figures"] or {}).get("pictures"), 300.0)
            pids = server.pids()
            stop = threading.Event()
            viewer = threading.Thread(target=watch_pictures, args=(server, stop), daemon=True)
            viewer.start()
            time.sleep(3.0)
            before = shown(server)
            with recorded(folder, "frame", list(pids.values()), frame):
                time.sleep(options.seconds)
            pictures = shown(server) - before
            stop.set()
            viewer.join(30)
            server.ask(f"/v1/streams/{STREAM}/stop", "POST")
            time.sleep(2.0)
            with recorded(folder, "idle", [pids["control"]], idle):
                time.sleep(2.0)
            with recorded(folder, "creation", [pids["control"]], creation):
                server.ask("/v1/streams", "POST", {"name": "second", "source": options.source, "start": False})
        roles = {role: frame.get(pid, {}) for role, pid in pids.items()}
        missing = [role for role, modules in roles.items() if not modules]
        if missing:
            print(f"no modules were recorded in: {', '.join(missing)}", file=sys.stderr)
            return 1
        report = {
            "pictures": pictures,
            "frame": summary(*roles.values()),
            "every frame": summary(*(often(trace, pictures / 2) for trace in roles.values())),
            **{f"frame, {role} process": summary(modules) for role, modules in roles.items()},
            "creation of a stream": summary(
                {
                    module: called
                    for module, called in creation[pids["control"]].items()
                    if module not in idle[pids["control"]]
                }
            ),
        }
    print(json.dumps(report, indent=1))
    return 0


def shown(server: Server) -> int:
    """Return the number of pictures that the stream has displayed."""
    return server.stream()["processes"]["engine"]["figures"]["pictures"]


def watch_pictures(server: Server, stop: threading.Event) -> None:
    """Receive the pictures of the stream in this process until asked to stop."""
    from services.client import Client

    with Client(f"http://127.0.0.1:{server.port}", key=server.key) as client:
        for _ in client.pictures(STREAM):
            if stop.is_set():
                return


if __name__ == "__main__":
    sys.exit(main())
