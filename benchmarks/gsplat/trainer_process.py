"""One training by gsplat's example trainer, as a process of its own: `trainer.py` starts it.

    python benchmarks/gsplat/trainer_process.py SEED FACTS SCRIPT [ARGUMENTS]
    python -m gsplat_core.as_gsplat benchmarks/gsplat/trainer_process.py SEED FACTS SCRIPT [ARGUMENTS]

The first command trains with an installed gsplat, the second with this package. SCRIPT runs unchanged. It has no option for
its seed, so SEED is added to the number that it seeds with. FACTS is a JSON file with what the trainer does not log.
"""

from __future__ import annotations

import functools
import importlib
import json
import resource
import runpy
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, Literal

import stand_ins
from torch.utils.data import dataloader


def complete() -> None:
    """Add the names that the trainer of gsplat 1.6 uses, and 1.5.3 lacks."""
    wrapper, rendering, strategy = (
        importlib.import_module(f"gsplat.{name}") for name in ("cuda._wrapper", "rendering", "strategy")
    )
    if not hasattr(wrapper, "CameraModel"):
        wrapper.CameraModel = Literal["pinhole", "ortho", "fisheye", "ftheta"]
    if not hasattr(rendering, "RasterizeMode"):
        rendering.RasterizeMode = Literal["classic", "antialiased"]
    if not hasattr(strategy.MCMCStrategy, "noise_injection_stop_iter"):
        strategy.MCMCStrategy.noise_injection_stop_iter = -1


def add_seed(seed: int) -> None:
    """Add `seed` to the number that the trainer seeds with."""
    utils: Any = importlib.import_module("utils")
    given = utils.set_random_seed
    utils.set_random_seed = lambda number: given(number + seed)


def watch_waiting() -> defaultdict[str, float]:
    """Return the seconds that each split of the pictures is waited for."""
    waited: defaultdict[str, float] = defaultdict(float)
    # The loader has no public hook; every iterator of it derives from this class.
    base: Any = dataloader._BaseDataLoaderIter
    following = base.__next__

    @functools.wraps(following)
    def timed(self: Any) -> Any:
        begin = time.perf_counter()
        try:
            return following(self)
        finally:
            waited[self._dataset.split] += time.perf_counter() - begin

    base.__next__ = timed
    return waited


def main() -> None:
    """Train, and write the facts."""
    seed, facts, script, *arguments = sys.argv[1:]
    sys.argv = [script, *arguments]
    here = Path(__file__).resolve().parent
    sys.path[:] = [str(Path(script).resolve().parent), *(each for each in sys.path if Path(each).resolve() != here)]
    replaced = stand_ins.install()
    complete()
    add_seed(int(seed))
    waited = watch_waiting()
    # The first step of an optimiser imports this package of torch, which takes seconds and would count as training.
    importlib.import_module("torch._dynamo")
    runpy.run_path(script, run_name="__main__")
    gsplat = importlib.import_module("gsplat")
    found = {
        "gsplat": "gsplat_core" if Path(str(gsplat.__file__)).parent.name == "as_gsplat" else str(gsplat.__version__),
        "replaced": replaced,
        "waiting_s": waited["train"],
        "peak_memory_kib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }
    Path(facts).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
