"""gsplat's example trainer with gsplat and with this package, on a synthetic scene in COLMAP's format.

    PYTHONPATH=build/peers python benchmarks/gsplat/trainer.py EXAMPLES [--device cuda] [--full] [--wide] [--seeds 0 1 2] --out FILE

EXAMPLES is the folder `examples` of gsplat's sources with `simple_trainer.py`. `build/peers` holds gsplat, compiled by
`benchmarks/peers/build_gsplat.py`. Every training is a process of its own. The variants of one seed run one after the
other with the same arguments, in the opposite order for the next seed, and times are divided by that of gsplat with the
same seed. On the CPU only this package runs, and EXAMPLES must be a copy without CUDA devices.

- `gsplat`: gsplat
- `ours`: this package through `python -m gsplat_core.as_gsplat`
- `ours-selective`: the same with `--visible_adam`, the trainer's option for `SelectiveAdam`
- `gsplat-selective`: gsplat with that option

gsplat 1.5.3 never resets opacities, so `default` has `--strategy.compat 1.5.3` with this package. `fused_ssim` is this
package's in all variants unless the package fused-ssim is installed. Packages that the trainer imports and the machine
lacks are replaced by `stand_ins.py`. Figures: median and worst of the seeds.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import colmap_scene
import log
from static import LARGE, SMALL

ROOT = Path(__file__).resolve().parents[2]
STRATEGIES = ("default", "mcmc")
STEPS_OF_TRAINER = 30_000
FEWEST_STEPS = 300
WIDE = {"views": 120, "width_px": 1280, "height_px": 960, "points": 100_000, "per_unit": 440}
"""Size of the scene of `--wide`, at which the GPU rather than the host determines the time of a step."""
STEPS, CAP = {False: 300, True: 6000}, {False: 5000, True: 200_000}
"""Steps, and the cap of mcmc, for the small and the large scene."""
WIDE_CAP = 1_000_000
"""Cap of mcmc for the scene of `--wide`."""


@dataclass(frozen=True)
class Variant:
    """Package and further arguments of a training."""

    ours: bool
    arguments: tuple[str, ...] = ()


VARIANTS = {
    "gsplat": Variant(False),
    "ours": Variant(True),
    "ours-selective": Variant(True, ("--visible_adam",)),
    "gsplat-selective": Variant(False, ("--visible_adam",)),
}
USUAL = ("gsplat", "ours", "gsplat-selective", "ours-selective")


def command(strategy: str, variant: Variant, seed: int, scene: Path, folder: Path, chosen: Any) -> list[str]:
    """Return the command of one training with its results in `folder`."""
    # The trainer rounds products with the factor down.
    factor = (chosen.steps + 0.5) / STEPS_OF_TRAINER
    words = [sys.executable, *(("-m", "gsplat_core.as_gsplat") if variant.ours else ())]
    words += [str(Path(__file__).with_name("trainer_process.py")), str(seed), str(folder / "facts.json")]
    words += [str(chosen.examples / "simple_trainer.py"), strategy, "--disable_viewer", "--disable_video"]
    words += ["--data_dir", str(scene), "--data_factor", "1", "--result_dir", str(folder)]
    words += ["--steps_scaler", f"{factor:.9f}"]
    for name in ("eval_steps", "save_steps"):
        words += [f"--{name}", str(STEPS_OF_TRAINER)]
    if strategy == "mcmc":
        words += ["--strategy.cap-max", str(chosen.cap)]
    elif variant.ours:
        words += ["--strategy.compat", "1.5.3"]
    return [*words, *variant.arguments]


def train(strategy: str, name: str, seed: int, scene: Path, chosen: Any) -> dict[str, Any]:
    """Train in a process of its own, and return the figures that the trainer and `trainer_process.py` logged."""
    with tempfile.TemporaryDirectory(prefix="trainer-") as place:
        folder = Path(place)
        words = command(strategy, VARIANTS[name], seed, scene, folder, chosen)
        environment = os.environ | {"PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"}
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{strategy} with {name} failed:\n{(done.stdout + done.stderr)[-4000:]}")
        last = chosen.steps - 1
        trained, scored, facts = (
            json.loads(path.read_text(encoding="utf-8"))
            for path in (
                folder / f"stats/train_step{last:04d}_rank0.json",
                folder / f"stats/val_step{last:04d}.json",
                folder / "facts.json",
            )
        )
    return {
        "strategy": strategy,
        "variant": name,
        "seed": seed,
        "psnr_db": round(scored["psnr"], 3),
        "ssim": round(scored["ssim"], 4),
        "gaussians": scored["num_GS"],
        "peak_mib": round(trained["mem"] * 1024 if chosen.device == "cuda" else facts["peak_memory_kib"] / 1024, 1),
        "training_s": round(trained["ellipse_time"], 3),
        "waiting_s": round(facts["waiting_s"], 3),
        "gsplat": facts["gsplat"],
        "replaced": facts["replaced"],
    }


def summary(runs: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return median and worst of each strategy and variant, with the ratios of times to gsplat with the same seed."""
    found: dict[str, Any] = {}
    every = list(runs)
    for strategy in STRATEGIES:
        own = [run for run in every if run["strategy"] == strategy]
        peers = {run["seed"]: run for run in own if run["variant"] == "gsplat"}
        for name in VARIANTS:
            if chosen := [run for run in own if run["variant"] == name]:
                pairs = [(run, peers[run["seed"]]) for run in chosen if run["seed"] in peers]
                found.setdefault(strategy, {})[name] = {
                    **{key: _both([run[key] for run in chosen], min) for key in ("psnr_db", "ssim")},
                    **{key: _both([run[key] for run in chosen], max) for key in ("gaussians", "peak_mib", "training_s", "waiting_s")},
                    "time_ratio": _both([one["training_s"] / other["training_s"] for one, other in pairs], max),
                    "busy_ratio": _both([_busy(one) / _busy(other) for one, other in pairs], max),
                    "seeds": len(chosen),
                }  # fmt: skip
    return found


def _busy(run: dict[str, Any]) -> float:
    """Return the training time without that in which pictures were waited for."""
    return float(run["training_s"] - run["waiting_s"])


def _both(values: Sequence[float], worst: Any) -> list[float] | None:
    return [round(statistics.median(values), 4), round(worst(values), 4)] if values else None


def earlier_runs(path: Path | None, stated: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the runs of an earlier log of the same trainings."""
    if path is None:
        return []
    earlier = json.loads(path.read_text(encoding="utf-8"))
    different = [name for name, value in stated.items() if earlier[name] != value]
    if different:
        raise SystemExit(f"{path} has other values of {', '.join(different)}; give the same sizes")
    return list(earlier["runs"])


def main() -> None:
    """Train, and write the log after each training."""
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("examples", type=Path, help="folder examples of gsplat's sources")
    parser.add_argument("--steps", type=int, help="steps of a training; 300, or 6,000 with --full")
    parser.add_argument("--cap", type=int, help="cap of mcmc; 5,000, or 200,000 with --full")
    parser.add_argument(
        "--wide", action="store_true", help="pictures of 1280x960 and up to a million splats; with --full"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--strategies", nargs="+", choices=STRATEGIES, default=STRATEGIES)
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), help=f"by default {', '.join(USUAL)}")
    parser.add_argument("--earlier", type=Path, help="log of an earlier call; its runs are kept and not repeated")
    chosen = parser.parse_args()
    chosen.steps, chosen.cap = (
        chosen.steps or STEPS[chosen.full],
        chosen.cap or (WIDE_CAP if chosen.wide else CAP[chosen.full]),
    )
    if chosen.steps < FEWEST_STEPS:
        parser.error(f"--steps is {chosen.steps}; give at least {FEWEST_STEPS}, where the trainer refines at each step")
    places = {str(chosen.examples): "EXAMPLES", str(chosen.earlier): "FILE"}
    sys.argv[1:] = [places.get(word, word) for word in sys.argv[1:]]
    chosen.examples = chosen.examples.resolve()
    names = chosen.variants or [name for name in USUAL if chosen.device == "cuda" or VARIANTS[name].ours]
    size = WIDE if chosen.wide else LARGE if chosen.full else SMALL
    stated = {"scene": size, "steps": chosen.steps, "cap": chosen.cap}
    runs = earlier_runs(chosen.earlier, stated)
    known = {(run["strategy"], run["variant"], run["seed"]) for run in runs}
    with tempfile.TemporaryDirectory(prefix="scene-") as folder:
        scene = Path(folder) / "scene"
        colmap_scene.write_scene(scene, **size, device=chosen.device)
        for number, seed in enumerate(chosen.seeds):
            for strategy in chosen.strategies:
                for name in names[:: -1 if number % 2 else 1]:
                    if (strategy, name, seed) not in known:
                        runs.append(train(strategy, name, seed, scene, chosen))
                        print(json.dumps(runs[-1]), flush=True)
                        write(chosen, {**stated, "runs": runs, "summary": summary(runs)})
    for strategy, variants in summary(runs).items():
        for name, figures in variants.items():
            print(strategy, name, json.dumps(figures))


def write(chosen: argparse.Namespace, figures: dict[str, Any]) -> None:
    """Write the log without printing all its runs."""
    with contextlib.redirect_stdout(io.StringIO()):
        log.write("trainer", chosen, figures, folder="gsplat")


if __name__ == "__main__":
    main()
