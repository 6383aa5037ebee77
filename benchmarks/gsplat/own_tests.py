"""gsplat's own tests, run with this package in place of gsplat.

    python benchmarks/gsplat/own_tests.py --tests FOLDER [--oracle FOLDER] [--device cpu|cuda] [--only test_basic.py ...]

FOLDER holds the files `test_*.py` of gsplat 1.5.3's source distribution. They are copied to a temporary folder, in which
`torch.device("cuda:0")` is replaced by the chosen device, and `torch.cuda.is_available()` by True. gsplat's test scene
`assets/test_garden.npz` is used if it is next to FOLDER. Otherwise a synthetic scene of the same layout takes its place.

The tests compare functions with gsplat's own functions in plain torch. With `--oracle`, the folder `gsplat` of an unpacked
wheel of 1.5.3, these are gsplat's (`cuda/_torch_impl.py`, `cuda/_torch_impl_2dgs.py`, `_rasterization`), and the constants
are those of 1.5.3. On the CPU `_rasterize_to_pixels_2dgs` stays this package's, because gsplat's needs more than 10 GB for its
test. This script contains the two functions of nerfacc that gsplat's functions call. Without `--oracle`, the tests compare the
compiled functions with this package's reference in `gsplat_core/reference/`.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "methods"))

import log

ROOT = Path(__file__).resolve().parents[2]
FILES = ("test_basic.py", "test_rasterization.py", "test_strategy.py", "test_2dgs.py", "test_compression.py")
NERFACC = """
import torch


def _starts(ray_indices, n_rays):
    lengths = torch.bincount(ray_indices, minlength=n_rays)
    ends = torch.cumsum(lengths, 0)
    return ends - lengths, ends


def render_weight_from_alpha(alphas, ray_indices, n_rays):
    logs = torch.cumsum(torch.log1p(-alphas.double()), 0)
    before = torch.cat([logs.new_zeros(1), logs])
    starts, _ = _starts(ray_indices, n_rays)
    trans = torch.exp(before[:-1] - before[starts[ray_indices]]).to(alphas.dtype)
    return alphas * trans, trans


def accumulate_along_rays(weights, values, ray_indices, n_rays):
    terms = weights[:, None] if values is None else weights[:, None] * values
    sums = torch.cat([terms.new_zeros(1, terms.shape[1], dtype=torch.float64), torch.cumsum(terms.double(), 0)])
    starts, ends = _starts(ray_indices, n_rays)
    return (sums[ends] - sums[starts]).to(weights.dtype)
"""
"""Module with the functions of nerfacc that gsplat's functions in plain torch call."""
CONFTEST = """
import importlib.util
import sys
from pathlib import Path

import gsplat.cuda._torch_impl_2dgs
import gsplat.cuda._wrapper
import gsplat.rendering

FOLDER = Path({folder!r})


def loaded(name, path):
    spec = importlib.util.spec_from_file_location(name, FOLDER / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


gsplat.cuda._torch_impl = loaded("gsplat.cuda._torch_impl", "cuda/_torch_impl.py")
blended = gsplat.cuda._torch_impl_2dgs._rasterize_to_pixels_2dgs
gsplat.cuda._torch_impl_2dgs = loaded("gsplat.cuda._torch_impl_2dgs", "cuda/_torch_impl_2dgs.py")
if {small!r}:
    gsplat.cuda._torch_impl_2dgs._rasterize_to_pixels_2dgs = blended
gsplat.rendering._rasterization = loaded("gsplat._own_rendering", "rendering.py")._rasterization
"""
"""conftest.py that puts gsplat's functions in plain torch in the place of this package's."""


def synthetic_scene(path: Path, points: int, width: int, height: int) -> None:
    """Write points on a textured bowl and three cameras around them, in the layout of gsplat's test scene."""
    random = np.random.default_rng(42)
    plane = random.uniform(-1.9, 1.9, (points, 2))
    z = 0.25 * (plane**2).sum(1) - 0.8 + 0.1 * np.sin(7 * plane[:, 0]) + random.normal(0, 0.01, points)
    means = np.column_stack([plane, z])
    colors = np.uint8(127 + 120 * np.sin(np.column_stack([5 * plane[:, 0], 4 * plane[:, 1], 6 * plane.sum(1)])))
    viewmats = []
    for angle in (-0.5, 0.0, 0.6):
        eye = np.array([3 * np.sin(angle), 0.4, 3 * np.cos(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 1, 0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        viewmats.append(pose)
    focal = 0.8 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path, means3d=np.float32(means), colors=colors, viewmats=np.float32(viewmats), Ks=np.float32([K] * 3), width=width, height=height
    )  # fmt: skip


def prepared(source: Path, folder: Path, device: str, chosen: argparse.Namespace) -> str:
    """Copy the tests to `folder`, adapted to the device. Return a description of the test scene."""
    tests = folder / "tests"
    tests.mkdir()
    for path in source.glob("test_*.py"):
        text = path.read_text(encoding="utf-8")
        text = text.replace('torch.device("cuda:0")', f'torch.device("{device}")')
        text = text.replace("torch.cuda.is_available()", "True")
        # Recent versions of pytest refuse marks on fixtures.
        text = re.sub(r"(@pytest\.fixture\n)@pytest\.mark\.skipif\(.*\)\n", r"\1", text)
        text = text.replace("/tmp/gsplat/compression", str(folder / "compressed"))
        (tests / path.name).write_text(text, encoding="utf-8")
    (folder / "compressed").mkdir()
    if chosen.oracle is not None:
        (tests / "nerfacc.py").write_text(NERFACC, encoding="utf-8")
        (tests / "conftest.py").write_text(
            CONFTEST.format(folder=str(chosen.oracle.resolve()), small=device == "cpu"), encoding="utf-8"
        )
    scene = folder / "assets" / "test_garden.npz"
    given = source.parent / "assets" / "test_garden.npz"
    if given.exists():
        scene.parent.mkdir()
        shutil.copy(given, scene)
        return "gsplat's test_garden.npz"
    synthetic_scene(scene, chosen.points, chosen.width, chosen.height)
    return f"synthetic, {chosen.points} points, 3 pictures of {chosen.width}x{chosen.height} px"


def run(
    folder: Path, name: str, oracle: bool, timeout_s: float, further: list[str], peer: Path | None = None
) -> dict[str, dict[str, Any]]:
    """Run one test file with this package, or with the gsplat in the folder `peer`.

    Returns:
        By test, its `outcome`, its duration in `seconds`, and the start of the failure message as `why`.
    """
    report = folder / f"{name}{'' if peer is None else '-peer'}.xml"
    command = [sys.executable]
    if peer is None:
        command += ["-m", "gsplat_core.as_gsplat", "--constants", "1.5.3" if oracle else "1.6"]
    else:
        further = [*further, "--noconftest"]
    command += ["-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += [f"--junit-xml={report}", f"--rootdir={folder}", str(folder / "tests" / name), *further]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(peer or ROOT), os.environ.get("PYTHONPATH", "")])}
    try:
        subprocess.run(command, cwd=folder, env=environment, check=False, timeout=timeout_s, stdout=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return {name: {"outcome": "failed", "seconds": timeout_s, "why": "time limit"}}
    if not report.exists():
        return {name: {"outcome": "failed", "seconds": 0.0, "why": "pytest wrote no report"}}
    found: dict[str, dict[str, Any]] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        trouble = [child for child in case if child.tag in ("failure", "error", "skipped")]
        outcome = "passed" if not trouble else "skipped" if trouble[0].tag == "skipped" else "failed"
        about: dict[str, Any] = {"outcome": outcome, "seconds": round(float(case.get("time", 0)), 2)}
        if trouble:
            about["why"] = (trouble[0].get("message") or "").replace(str(folder), "")[:300]
        found[f"{name}::{case.get('name')}"] = about
    return found


def main() -> None:
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument("--tests", type=Path, required=True, help="folder of gsplat's tests")
    parser.add_argument("--oracle", type=Path, help="folder gsplat of an unpacked wheel of 1.5.3")
    parser.add_argument("--peer", type=Path, help="folder with a compiled gsplat 1.5.3, which runs the same tests")
    parser.add_argument("--only", nargs="+", default=FILES, help="files to run")
    parser.add_argument("--points", type=int, default=20_000, help="points of the synthetic scene")
    parser.add_argument("--width", type=int, default=320, help="width of its pictures")
    parser.add_argument("--height", type=int, default=240, help="height of its pictures")
    parser.add_argument("-k", dest="selection", help="pytest's selection of tests")
    parser.add_argument(
        "--select", nargs=2, action="append", default=[], metavar=("FILE", "EXPRESSION"), help="selection for one file"
    )
    parser.add_argument("--together", type=int, default=1, help="files that are run at the same time")
    parser.add_argument(
        "--timeout", type=float, default=3600, help="seconds after which a file is ended and counts as failed"
    )
    chosen = parser.parse_args()
    device = "cuda:0" if chosen.device == "cuda" else chosen.device
    tests: dict[str, dict[str, Any]] = {}
    files: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = prepared(chosen.tests.resolve(), folder, device, chosen)

        def results(file: str) -> dict[str, dict[str, Any]]:
            selection = dict(chosen.select).get(file, chosen.selection)
            return run(folder, file, chosen.oracle is not None, chosen.timeout, ["-k", selection] if selection else [])

        def results_of_peer(file: str) -> dict[str, dict[str, Any]]:
            return run(folder, file, False, chosen.timeout, [], chosen.peer.resolve())

        with ThreadPoolExecutor(chosen.together) as pool:
            results_with_peer = pool.map(results_of_peer, chosen.only if chosen.peer else ())
            results_of_files = pool.map(results, chosen.only)
        for file, found in zip(chosen.only, results_of_files, strict=True):
            outcomes = [about["outcome"] for about in found.values()]
            files[file] = {outcome: outcomes.count(outcome) for outcome in ("passed", "failed", "skipped")}
            tests |= found
            print(file, files[file], flush=True)
        failed_with_peer = [
            test for found in results_with_peer for test, about in found.items() if about["outcome"] == "failed"
        ]
    failed = {name: about.get("why", "") for name, about in tests.items() if about["outcome"] == "failed"}
    for test, why in failed.items():
        print(f"FAILED {test}: {why}")
    oracle = "gsplat's functions in plain torch" if chosen.oracle else "this package's reference"
    figures = {
        "gsplat": "1.5.3",
        "compared_with": oracle,
        "scene": scene,
        "files": files,
        "tests": tests,
        "failed_with_gsplat": failed_with_peer if chosen.peer else None,
    }
    for test in failed_with_peer:
        print(f"FAILED with gsplat itself: {test}")
    places = {str(chosen.tests): "TESTS", str(chosen.oracle): "GSPLAT", str(chosen.peer): "PEER"}
    sys.argv[1:] = [places.get(word, word) for word in sys.argv[1:]]
    log.write("own_tests", chosen, figures, "gsplat")


if __name__ == "__main__":
    main()
