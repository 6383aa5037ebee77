"""Splat files of other programs: loading time and memory, size and quality of the formats, frame rate along a path.

    python benchmarks/methods/pretrained.py [--count N] [--renderers alpha,stochastic] [--full] [--device cpu|cuda] [--out FILE]

The scene is random: small Gaussians of degree 3 in a ball, in front of a camera that moves on a circle. Loading and rendering run in
processes of their own, so that the peak memory is theirs. Loading is timed with the file in the page cache.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import log
import numpy as np
import torch

from gsplat_core.choices import RENDERERS
from gsplat_core.io.exports.export import export_model
from gsplat_core.io.exports.formats import ExportWish, format_named
from gsplat_core.io.model_sources import load_model
from gsplat_core.io.ply import header_lines, ply_pieces
from gsplat_core.scene.gaussians import Gaussians

BLOCK = 250_000
ROOT = Path(__file__).resolve().parents[2]
LOAD = """
import json, sys, time
from pathlib import Path
from gsplat_core.io.model_sources import READERS
from gsplat_core.machine import peak_bytes
path = Path(sys.argv[1])
Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
before, begun = peak_bytes(), time.perf_counter()
gaussians = READERS[path.suffix](path)
took = time.perf_counter() - begun
held = sum(tensor.nbytes for tensor in gaussians.tensors().values())
print(json.dumps({"s": took, "peak_growth_bytes": peak_bytes() - before, "tensor_bytes": held, "count": gaussians.count}))
"""


def random_gaussians(count: int, total: int, seed: int) -> Gaussians:
    """Return part of a ball of radius 1; the sizes shrink with the total number, so that the surface stays covered."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    means = direction * (0.7 + 0.3 * torch.rand(count, 1, generator=g))
    size = math.log(1.5 / math.sqrt(total))
    return Gaussians(
        means,
        torch.randn(count, 4, generator=g),
        size + 0.4 * torch.randn(count, 3, generator=g),
        torch.randn(count, generator=g) * 1.5 + 1,
        torch.cat([torch.randn(count, 1, 3, generator=g), 0.1 * torch.randn(count, 15, 3, generator=g)], 1),
    )


def write_scene(path: Path, count: int) -> None:
    """Write a `.ply` block by block, so that a scene of any size can be written."""
    with open(path, "wb") as file:
        for first in range(0, count, BLOCK):
            header, *rows = ply_pieces(random_gaussians(min(BLOCK, count - first), count, first))
            if first == 0:
                names = [line[9:] for line in header.decode().splitlines() if line.startswith("property ")]
                file.write("\n".join(header_lines([("vertex", count, names)])).encode())
            for piece in rows:
                file.write(piece)


def write_path(path: Path, cameras: int = 60) -> None:
    """Write a circle of cameras at a distance of 2.5 that face the centre."""
    listed = []
    for k in range(cameras + 1):
        angle = 2 * math.pi * k / cameras
        pose = np.eye(4)
        pose[:3, 0] = math.cos(angle), 0, -math.sin(angle)
        pose[:3, 2] = math.sin(angle), 0, math.cos(angle)
        pose[:3, 3] = -2.5 * pose[:3, 2]
        listed.append({"time_s": float(k), "camera_to_world": pose.tolist()})
    path.write_text(json.dumps({"cameras": listed}))


def child(*words: str) -> dict[str, Any]:
    """Run Python in a process of its own and return the JSON that it prints."""
    ran = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False)
    if ran.returncode:
        return {"failed": ran.stderr.strip().splitlines()[-1][:300] if ran.stderr.strip() else f"exit {ran.returncode}"}
    found: dict[str, Any] = json.loads(ran.stdout)
    return found


def formats(folder: Path, count: int) -> dict[str, Any]:
    """Return size, loading and PSNR against the float `.ply` of each format."""
    write_scene(folder / "small.ply", count)
    model = load_model(folder / "small.ply")
    camera = model.camera.fitted(320, 256)
    wanted = model.render(0.0, camera).image
    figures = {}
    for name in ("ply", "compressed-ply", "splat", "spz"):
        path = folder / f"small-{name}{format_named(name).suffix}"
        size = export_model(model, path, ExportWish(format_named(name)))
        shown = load_model(path).render(0.0, camera).image
        error = float((shown.clamp(0, 1) - wanted.clamp(0, 1)).square().mean())
        figures[name] = {
            "bytes_per_gaussian": round(size / count, 1),
            "psnr_to_ply_db": None if error == 0 else round(-10 * math.log10(error), 2),
            "load_s_per_million": round(child("-c", LOAD, str(path)).get("s", math.nan) / count * 1e6, 2),
        }
    return figures


def main() -> None:
    """Run the benchmark."""
    parser = log.options(__doc__.splitlines()[0])
    parser.add_argument(
        "--count", type=int, help="Gaussians of the large scene; default 200,000, with --full 10 million"
    )
    parser.add_argument("--renderers", help="names, separated by commas; default: all that run on the device")
    parser.add_argument("--frames", type=int, help="frames of the path; default 20, with --full 600")
    chosen = parser.parse_args()
    count = chosen.count or (10_000_000 if chosen.full else 200_000)
    frames = chosen.frames or (600 if chosen.full else 20)
    size = ("1920", "1080") if chosen.full else ("480", "270")
    if chosen.renderers:
        names = chosen.renderers.split(",")
    else:
        names = [name for name in RENDERERS if chosen.device in RENDERERS[name].capabilities.precisions]
    figures: dict[str, Any] = {"gaussians": count, "sh_degree": 3, "size_px": [int(side) for side in size]}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_scene(folder / "scene.ply", count)
        write_path(folder / "path.json")
        figures["file_bytes"] = (folder / "scene.ply").stat().st_size
        figures["load"] = child("-c", LOAD, str(folder / "scene.ply"))
        if "s" in figures["load"]:
            figures["load"]["peak_growth_over_tensors"] = round(
                figures["load"]["peak_growth_bytes"] / figures["load"]["tensor_bytes"], 3
            )
        words = ["-m", "services.cli", "bench", str(folder / "scene.ply"), "--json", "--device", chosen.device]
        words += ["--path", str(folder / "path.json"), "--frames", str(frames), "--width", size[0], "--height", size[1]]
        for name in names:
            sampled = [1, 16] if "samples" in RENDERERS[name].capabilities.options else [None]
            for samples in sampled:
                more = [] if samples is None else ["--samples", str(samples)]
                figures[f"bench {' '.join([name, *more])}"] = child(*words, "--renderer", name, *more)
        figures["formats"] = formats(folder, min(count, 1_000_000 if chosen.full else 20_000))
    log.write("pretrained", chosen, figures)


if __name__ == "__main__":
    main()
