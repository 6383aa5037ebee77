"""Swap models while a stream shows them, by activations and rollbacks over the API of a real `intrasplat serve`.

    python benchmarks/service_swaps.py --swaps 100

Examines every picture that the engine publishes: whether a frame has no picture, whether the pixels equal the rendering of the named version, and whether that version was
active. `followed_ms` is the time from a call's answer to the first picture of the new version. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import random
import threading
import time
from dataclasses import dataclass
from typing import Any

import service_models
import zmq
from service_server import STREAM, Server
from service_watchers import quantiles

from services.bus.messages import picture_from, subscribe

SOURCE = "synthetic:?width=640&height=512&frames=24&fps=30"


@dataclass(frozen=True)
class Shown:
    """Published picture."""

    seq: int
    version: int
    new: bool
    at_ns: int
    pixels: str


class Pictures:
    """Recorder of all pictures of the engine, in a thread."""

    def __init__(self, endpoint: str) -> None:
        self.seen: list[Shown] = []
        self._endpoint, self._stop = endpoint, threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        socket = subscribe(zmq.Context.instance().socket(zmq.SUB), self._endpoint, waiting=256)
        while not self._stop.is_set():
            if socket.poll(50):
                picture = picture_from(socket.recv_multipart(copy=False))
                header = picture.header
                if header["show"] == "model":
                    pixels = hashlib.blake2b(picture.image, digest_size=8).hexdigest()
                    self.seen.append(
                        Shown(header["seq"], header["model_version"], header["new"], header["shown_ns"], pixels)
                    )
        socket.close()

    def until(self, version: int, after_ns: int, within_s: float = 60.0) -> Shown:
        """Return the first picture of a version after a time."""
        until_s, at = time.monotonic() + within_s, max(0, len(self.seen) - 1)
        while time.monotonic() < until_s:
            for each in self.seen[at:]:
                if each.version == version and each.at_ns > after_ns:
                    return each
            time.sleep(0.005)
        raise TimeoutError(f"version {version} was not shown; the newest picture is {self.seen[-1:]}")

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()


@dataclass(frozen=True)
class Swap:
    """Change of the active version."""

    version: int
    asked_ns: int
    answered_ns: int
    first: Shown


def swapped(server: Server, pictures: Pictures, versions: list[int], count: int) -> list[Swap]:
    """Activate two versions alternately, or roll back, at random times."""
    choose, active = random.Random(0), versions[0]
    swaps = []
    for index in range(count):
        time.sleep(choose.uniform(0.1, 0.4))
        asked_ns = time.monotonic_ns()
        if index % 2 == 0:
            target = versions[1 - versions.index(active)]
            service_models.activate(server, target, active)
            active = target
        else:
            active = service_models.roll_back(server)
        answered_ns = time.monotonic_ns()
        swaps.append(Swap(active, asked_ns, answered_ns, pictures.until(active, asked_ns)))
    return swaps


def judged(swaps: list[Swap], seen: list[Shown], first: int) -> dict[str, Any]:
    """Check the displayed pictures for lost frames and wrong versions around the swaps."""
    new = [each for each in seen if each.new]
    missing = [after.seq - before.seq - 1 for before, after in itertools.pairwise(new)]
    at_swaps = {swap.first.seq for swap in swaps}
    lost_at_swaps = [gap for gap, after in zip(missing, new[1:], strict=False) if gap and _near(after.seq, at_swaps)]
    faces: dict[int, set[str]] = {}
    for each in seen:
        faces.setdefault(each.version, set()).add(each.pixels)
    changes = [(swap.asked_ns, swap.first.at_ns, swap.version) for swap in swaps]
    wrong = sum(each.version not in _allowed(each.at_ns, changes, first) for each in seen)
    return {
        "swaps": len(swaps),
        "pictures": len(seen),
        "frames_without_picture": sum(missing),
        "frames_without_picture_at_swaps": sum(lost_at_swaps),
        "most_in_a_row_at_swaps": max(lost_at_swaps, default=0),
        "gap_ms": quantiles([(b.at_ns - a.at_ns) * 1e-6 for a, b in itertools.pairwise(new)]),
        "looks_of_each_version": {version: len(looks) for version, looks in sorted(faces.items())},
        "looks_of_two_versions": len(set.intersection(*faces.values())) if len(faces) > 1 else 0,
        "pictures_of_a_version_not_active": wrong,
        "followed_ms": quantiles([max(0.0, (swap.first.at_ns - swap.answered_ns) * 1e-6) for swap in swaps]),
    }


def _near(seq: int, swaps: set[int]) -> bool:
    return any(seq - distance in swaps for distance in range(-2, 3))


def _allowed(at_ns: int, changes: list[tuple[int, int, int]], first: int) -> set[int]:
    """Return the versions allowed at a time: the active one, or both during a change."""
    active = first
    for asked_ns, shown_ns, version in changes:
        if at_ns >= shown_ns:
            active = version
        elif at_ns >= asked_ns:
            return {active, version}
        else:
            break
    return {active}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default=SOURCE)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--swaps", type=int, default=100)
    parser.add_argument("--gaussians", type=int, default=8000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--height", type=int, default=256)
    options = parser.parse_args()
    with Server(options.source, device=options.device, show=f"model {service_models.NAME}") as server:
        versions = [
            service_models.upload(
                server, service_models.packed_model(seed, options.gaussians, options.width, options.height)
            )
            for seed in (1, 2)
        ]
        service_models.activate(server, versions[0], None)
        pictures = Pictures(f"ipc://{server.runtime / STREAM / 'shown'}")
        try:
            pictures.until(versions[0], 0, within_s=120.0)
            time.sleep(1)
            pictures.seen.clear()
            swaps = swapped(server, pictures, versions, options.swaps)
            time.sleep(0.5)
        finally:
            pictures.close()
        result = judged(swaps, list(pictures.seen), versions[0])
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
