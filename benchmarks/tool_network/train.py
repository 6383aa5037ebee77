"""Train the tool network on drawn pictures and export it for `gsplat_core/endoscope/tool_network.onnx`.

Worker processes draw pictures without pause. The main process keeps them on the device and trains on random ones, altered, until the time
is over. Backgrounds are drawn or come from recordings whose terms allow it: `colon` (CC BY 4.0), `organ_still` and `hamlyn_pair`
(BSD-3), `out_of_body` (Apache-2.0).

The weights are the mean over checkpoints, since long training on the same pictures finds less in real ones. How many of the last checkpoints are
averaged is decided by validation pictures. They are drawn from other seeds, half of them over photographs that training does not see
(`hamlyn_pair`). No annotated recording is read.

Usage: python -m benchmarks.tool_network.train FOLDER [--recordings DIR] [--device cuda] [--workers 16] [--minutes 8] [--seed 0] [--plain]
        [--start FOLDER] [--pictures FOLDER]
    python -m benchmarks.tool_network.train FOLDER --draw [--recordings DIR] [--workers 12] [--minutes 9]
    python -m benchmarks.tool_network.train FOLDER --export
FOLDER receives `tool_network.onnx`, `checkpoint.pt` (from half the time on), `kept.pt` (earlier weights, half precision) and `training.json`
(options, speed, validation). The second form writes pictures into FOLDER, from which several trainings read at the same time with
`--pictures`. The third form writes `tool_network.onnx` from `checkpoint.pt`. Only torch, numpy and OpenCV are needed.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import multiprocessing as mp
import queue
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Protocol
from unittest import mock

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, binary_cross_entropy_with_logits

from benchmarks.tool_network.network import INPUTS, ToolNetwork, features, fused
from benchmarks.tool_network.pictures import SIZE_PX, training_picture
from benchmarks.tool_network.recorded import RecordedTools
from benchmarks.tool_network.tissue import Photographs, TissuePool

INPUT_PX = (96, 128)
"""Height and width of the network's input, multiples of 32."""
LEARNING_RATE = 3e-3
WEIGHT_DECAY = 0.01
CHECKPOINTS = 24
"""Checkpoints of a run, at equal times."""
LAST_CHECKPOINTS = (1, 2, 4, 8, 12, 16)
"""Numbers of last checkpoints of which a mean is validated."""
AVERAGED = 0.998
"""Share of the weights' running mean that a step keeps."""
PASTED = 0.4
"""Share of pictures that get the tools of another one."""
TEXTURED = 0.1
"""Share of pictures whose tools get colours and texture of another picture, so that only shape and shading tell them."""
FILTERED = 0.4
"""Share of pictures that a random filter changes, whose fine structure then tells less."""
MIXED = 0.4
"""Share of pictures whose features get the style of another picture's."""
COARSE = 0.3
"""Weight of the loss of the coarse output."""
SENT_AT_ONCE = 8
"""Pictures that a worker sends in one message."""
IN_A_FILE = 64
"""Pictures in a file for several trainings."""
SAVED_EVERY = 8
"""Number of checkpoints of which one is saved in `kept.pt`."""
FIRST_PICTURES = 100
"""Training pictures of each worker before training begins."""
VALIDATION_SHARE = 0.1
"""Share of the time above which checkpoints are not validated."""
VALIDATION_SEED = 1_000_000
HELD_OUT = ("hamlyn_pair",)
"""Photographs that only validation pictures are drawn over."""

Pictures = NDArray[np.uint8]
"""RGB and coverage by tools, uint8 [N, h, w, 4]."""


class Pipe(Protocol):
    """Receiver of drawn pictures. The flag is true for validation pictures."""

    def put(self, message: tuple[bool, Pictures], /) -> None: ...


def four_channels(rng: np.random.Generator, pool: TissuePool, recorded: RecordedTools | None) -> Pictures:
    image, mask = training_picture(rng, pool, recorded)
    return np.concatenate([image, mask[..., None]], axis=2)


def draw(worker: int, workers: int, seed: int, recordings: Path | None, validation: int, to: Pipe) -> None:
    """Draw this worker's share of the validation pictures, then training pictures until the process is ended."""
    cv2.setNumThreads(1)
    held_out = Photographs(recordings, only=HELD_OUT) if recordings is not None else None
    for index in range(worker, validation, workers):
        # Each has its own seed, so that the set does not depend on the number of workers.
        chosen = held_out if index % 2 else None
        pool = TissuePool(chosen, new=1.0, photographed=1.0 if chosen else 0.0)
        to.put((True, four_channels(np.random.default_rng(VALIDATION_SEED + index), pool, None)[None]))
    rng = np.random.default_rng([seed, worker])
    pool = TissuePool(Photographs(recordings, without=HELD_OUT) if recordings is not None else None)
    recorded = RecordedTools(recordings) if recordings is not None else None
    while True:
        to.put((False, np.stack([four_channels(rng, pool, recorded) for _ in range(SENT_AT_ONCE)])))


def draw_files(worker: int, workers: int, seed: int, recordings: Path | None, validation: int, folder: Path) -> None:
    """Write what `draw` sends into files of a folder, until the process is ended."""

    class Files:
        def __init__(self) -> None:
            self.count, self.waiting = 0, list[Pictures]()

        def put(self, message: tuple[bool, Pictures]) -> None:
            validates, pictures = message
            self.waiting.append(pictures)
            if validates or sum(map(len, self.waiting)) >= IN_A_FILE:
                name = f"{'validation' if validates else 'training'}_{worker:03d}_{self.count:06d}"
                np.save(folder / f"{name}.part.npy", np.concatenate(self.waiting))
                (folder / f"{name}.part.npy").rename(folder / f"{name}.npy")
                self.waiting.clear()
                self.count += 1

    draw(worker, workers, seed, recordings, validation, Files())


def from_files(folder: Path, read: set[str]) -> Iterator[tuple[bool, Pictures]]:
    """Yield pictures from files that are not in `read`, at most 64 files, and add their names to it."""
    names = sorted(path.name for path in folder.glob("*_*.npy") if not path.name.endswith(".part.npy"))
    for name in [name for name in names if name not in read][:64]:
        read.add(name)
        yield name.startswith("validation"), np.load(folder / name)


class Store:
    """Drawn pictures on the device; new ones replace the oldest."""

    def __init__(self, size: int, device: torch.device) -> None:
        self.pictures = torch.zeros((size, *SIZE_PX, 4), dtype=torch.uint8, device=device)
        self.count = 0

    def add(self, pictures: Pictures) -> None:
        at = (self.count + torch.arange(len(pictures), device=self.pictures.device)) % len(self.pictures)
        self.pictures[at] = torch.from_numpy(pictures).to(self.pictures.device)
        self.count += len(pictures)

    def batch(
        self, size: int, chance: torch.Generator, plain: bool = False, grey: float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """Return altered pictures [N, 3, h, w] in 0..1, of `INPUT_PX`, and their coverage by tools [N, 1, h / 2, w / 2].

        `plain` leaves out the changes of texture. `grey` is the share of pictures with little or no colour.
        """
        there = min(self.count, len(self.pictures))
        at = torch.randint(0, there, (size,), generator=chance, device=self.pictures.device)
        return altered(reduced(self.pictures[at]), chance, plain, grey)


def reduced(pictures: Tensor) -> Tensor:
    """Return pictures uint8 [N, H, W, 4] as float32 [N, 4, h, w] in 0..1, of `INPUT_PX`."""
    planes = pictures.permute(0, 3, 1, 2).float() / 255
    return nn.functional.interpolate(planes, INPUT_PX, mode="bilinear", antialias=True)


def altered(both: Tensor, chance: torch.Generator, plain: bool = False, grey: float = 0.0) -> tuple[Tensor, Tensor]:
    """Return mirrored, turned, scaled, recoloured and blurred pictures, a share of them with the tools of another one.

    Unless `plain`, other shares have tools with foreign texture, and a random filter. A share of `grey` has at most 80 % of its
    saturation, so that tools are told by their shape.

    Drawing takes longer than training, so the pictures would be learned by heart otherwise.
    """
    count, device = len(both), both.device
    uniform = lambda *shape: torch.rand((count, *shape, 1, 1), generator=chance, device=device)
    normal = lambda *shape: torch.randn((count, *shape), generator=chance, device=device)
    pictures, cover = recoloured(both[:, :3], chance), both[:, 3:]
    if not plain:
        pictures = textured(pictures, cover, chance)
    others = torch.randperm(count, generator=chance, device=device)
    layer = cover[others] * (uniform(1) < PASTED)
    pictures = pictures + layer * (pictures[others] - pictures)
    cover = torch.maximum(cover, layer)
    angle, scale = 0.25 * normal(), torch.exp(0.2 * normal())
    aspect = INPUT_PX[1] / INPUT_PX[0]
    left = torch.where(uniform() < 0.5, -1.0, 1.0).flatten()
    down = torch.where(uniform() < 0.2, -1.0, 1.0).flatten()
    turns = torch.stack(
        [
            left * torch.cos(angle) * scale,
            -torch.sin(angle) * scale / aspect,
            0.12 * normal(),
            torch.sin(angle) * scale * aspect,
            down * torch.cos(angle) * scale,
            0.12 * normal(),
        ],
        dim=1,
    ).reshape(count, 2, 3)
    grid = nn.functional.affine_grid(turns, [count, 4, *INPUT_PX], align_corners=False)
    moved = nn.functional.grid_sample(
        torch.cat([pictures, cover], 1), grid, padding_mode="reflection", align_corners=False
    )
    pictures = recoloured(moved[:, :3], chance)
    if grey > 0:
        level = pictures.mean(1, keepdim=True)
        pictures = pictures + (uniform(1) < grey) * (1 - 0.8 * uniform(1)) * (level - pictures)
    if not plain:
        pictures = filtered(pictures, chance)
    light = nn.functional.interpolate(normal(1, 3, 4), INPUT_PX, mode="bicubic")
    pictures = pictures * torch.exp((uniform(1) < 0.4) * 0.3 * uniform(1) * light)
    soft = avg_pool2d(nn.functional.pad(pictures, (1, 1, 1, 1), mode="replicate"), 3, 1)
    kind = uniform(1)
    pictures = pictures + (kind < 0.25) * uniform(1) * (soft - pictures)
    pictures = pictures + (kind > 0.75) * 1.5 * uniform(1) * (pictures - soft)
    pictures = pictures + (uniform(1) < 0.3) * 0.03 * uniform(1) * normal(3, *INPUT_PX)
    return pictures.clamp(0, 1), avg_pool2d(moved[:, 3:], 2)


def textured(pictures: Tensor, cover: Tensor, chance: torch.Generator) -> Tensor:
    """Return pictures of which a share has tools with colours and texture of another picture and their own shading."""
    count, device = len(pictures), pictures.device
    others = torch.randperm(count, generator=chance, device=device)
    grey = pictures.mean(1, keepdim=True)
    level = (grey * cover).sum((2, 3), keepdim=True) / (cover.sum((2, 3), keepdim=True) + 1e-3) + 0.02
    gain = torch.exp(0.35 * torch.randn((count, 1, 1, 1), generator=chance, device=device))
    foreign = recoloured(pictures[others], chance).flip(3) * gain * (0.4 + 0.6 * grey / level).clamp(0.2, 2.5)
    chosen = torch.rand((count, 1, 1, 1), generator=chance, device=device) < TEXTURED
    return pictures + chosen * cover * (foreign.clamp(0, 1) - pictures)


def filtered(pictures: Tensor, chance: torch.Generator) -> Tensor:
    """Return pictures of which a share is changed by random filters with the sum 1, after Xu et al., "RandConv", 2021."""
    count, device = len(pictures), pictures.device
    side = 3 if torch.rand((), generator=chance, device=device) < 0.5 else 5
    kernels = torch.randn((count, 1, side, side), generator=chance, device=device) / side
    kernels = kernels - kernels.mean((2, 3), keepdim=True)
    strength = torch.rand((count, 1, 1, 1), generator=chance, device=device)
    strength = strength * (torch.rand((count, 1, 1, 1), generator=chance, device=device) < FILTERED)
    padded = nn.functional.pad(pictures, (side // 2,) * 4, mode="reflect").transpose(0, 1)
    change = nn.functional.conv2d(padded, kernels, groups=count).transpose(0, 1)
    return (pictures + strength * change).clamp(0, 1)


def recoloured(pictures: Tensor, chance: torch.Generator) -> Tensor:
    """Return pictures with other white balance, brightness, gamma and saturation."""

    def factor(spread: float, channels: int) -> Tensor:
        shape = (len(pictures), channels, 1, 1)
        return torch.exp(spread * torch.randn(shape, generator=chance, device=pictures.device))

    pictures = (pictures * factor(0.08, 3) * factor(0.15, 1)).clamp(1e-4, 1) ** factor(0.17, 1)
    grey = pictures.mean(1, keepdim=True)
    return (grey + (pictures - grey) * factor(0.17, 1)).clamp(0, 1)


def loss_of(logits: Tensor, cover: Tensor) -> Tensor:
    """Return the mean of cross-entropy and soft Dice."""
    entropy = binary_cross_entropy_with_logits(logits, cover, pos_weight=torch.tensor(2.0, device=logits.device))
    chance = torch.sigmoid(logits)
    both, sizes = (chance * cover).sum((1, 2, 3)), (chance + cover).sum((1, 2, 3))
    return entropy + 0.5 * (1 - (2 * both + 20) / (sizes + 20)).mean()


def mean_of(states: list[dict[str, Tensor]]) -> ToolNetwork:
    """Return a network with the mean of weights."""
    network = ToolNetwork().to(next(iter(states[0].values())).device)
    network.load_state_dict({name: sum(state[name].float() for state in states) / len(states) for name in states[0]})
    return network


def halved(value: Tensor) -> Tensor:
    """Return a tensor on the CPU, in half precision if it is of floating point."""
    return value.cpu().half() if value.is_floating_point() else value.cpu()


def settled(network: nn.Module, store: Store, batch: int) -> nn.Module:
    """Return a copy whose normalisations have the statistics of the mean weights, which a mean of statistics is not."""
    copied = copy.deepcopy(network).train()
    for part in copied.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.reset_running_stats()
            part.momentum = None
    chance = torch.Generator(store.pictures.device).manual_seed(0)
    with torch.no_grad():
        for _ in range(40):
            copied(features(store.batch(batch, chance)[0]))
    return copied.eval()


@torch.no_grad()
def validated(network: nn.Module, pictures: Tensor) -> dict[str, float]:
    """Return figures of the validation pictures: score, mean IoU, recall and share of false pixels.

    The score is the mean over all pictures of (intersection + s) / (union + s), with s = 0.5 % of the picture. It is 1 for
    a picture without tools in which none is found.
    """
    scores, ious, recalls, false_shares = [], [], [], []
    for part in pictures.split(100):
        planes = reduced(part)
        cover = avg_pool2d(planes[:, 3:], 2) > 0.5
        found = network(features(planes[:, :3])) > 0
        both, either = (found & cover).sum((1, 2, 3)), (found | cover).sum((1, 2, 3))
        small = 0.005 * cover[0].numel()
        scores.append((both + small) / (either + small))
        with_tool = cover.sum((1, 2, 3)) > 2 * small
        ious.append((both / either)[with_tool])
        recalls.append((both / cover.sum((1, 2, 3)))[with_tool])
        false_shares.append((found & ~cover).float().mean((1, 2, 3)))
    named = {"score": scores, "iou": ious, "recall": recalls, "false_share": false_shares}
    return {name: round(float(torch.cat(parts).mean()), 4) for name, parts in named.items()}


def export(network: nn.Module, path: Path) -> None:
    """Write the network as ONNX with normalisation folded into the convolutions."""
    # torch needs the package onnx only to add functions of onnxscript, of which there are none.
    unchanged = mock.patch(
        "torch.onnx._internal.torchscript_exporter.onnx_proto_utils._add_onnxscript_fn", lambda model, _: model
    )
    with unchanged, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            fused(network),
            (torch.zeros(1, INPUTS, *INPUT_PX),),
            str(path),
            input_names=["features"],
            output_names=["tool"],
            dynamo=False,
        )


def received(to: mp.Queue[tuple[bool, Pictures]], workers: list[BaseProcess]) -> Iterator[tuple[bool, Pictures]]:
    """Yield pictures that are ready, at most 64 messages.

    Raises:
        RuntimeError: if a worker has ended.
    """
    for _ in range(64):
        try:
            yield to.get_nowait()
        except queue.Empty:
            break
    for worker in workers:
        if not worker.is_alive():
            raise RuntimeError(f"a drawing process ended with exit code {worker.exitcode}; its traceback is above")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--minutes", type=float, default=30, help="time of the whole run, with first pictures")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--store", type=int, default=100_000, help="pictures that are kept, 82 kB each")
    parser.add_argument("--validation", type=int, default=800, help="number of validation pictures")
    parser.add_argument(
        "--first", type=int, default=0, help="training pictures before training begins, with --pictures"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=LEARNING_RATE)
    parser.add_argument("--plain", action="store_true", help="without foreign texture, random filters and mixed styles")
    parser.add_argument("--grey", type=float, default=0.0, help="share of pictures with little or no colour")
    parser.add_argument("--start", type=Path, help="folder of an earlier training, whose weights are trained further")
    parser.add_argument("--pictures", type=Path, help="folder into which --draw writes; no pictures are drawn then")
    parser.add_argument("--draw", action="store_true", help="only write pictures into FOLDER, for --minutes")
    parser.add_argument("--export", action="store_true", help="only write the ONNX file of checkpoint.pt")
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    if arguments.export:
        network = ToolNetwork()
        network.load_state_dict(torch.load(folder / "checkpoint.pt", map_location="cpu"))
        export(network, folder / "tool_network.onnx")
        return 0
    if arguments.recordings is not None and not (arguments.recordings / "colon").is_dir():
        parser.error(f"--recordings {arguments.recordings} has no folder 'colon'; give the folder of all recordings")
    began = time.monotonic()
    context = mp.get_context("fork")
    if arguments.pictures is not None:
        read: set[str] = set()
        return train(arguments, lambda: from_files(arguments.pictures, read), [], began)
    to: mp.Queue[tuple[bool, Pictures]] = context.Queue(4 * arguments.workers)
    shared = (arguments.workers, arguments.seed + 1, arguments.recordings, arguments.validation)
    if arguments.draw:
        shared, target = (*shared, folder), draw_files
    else:
        shared, target = (*shared, to), draw
    workers: list[BaseProcess] = [
        context.Process(target=target, args=(worker, *shared), daemon=True) for worker in range(arguments.workers)
    ]
    for worker in workers:
        worker.start()
    try:
        if arguments.draw:
            time.sleep(60 * arguments.minutes)
            return 0
        return train(arguments, lambda: received(to, workers), workers, began)
    finally:
        for worker in workers:
            worker.terminate()


def train(
    arguments: argparse.Namespace,
    drawn: Callable[[], Iterator[tuple[bool, Pictures]]],
    workers: list[BaseProcess],
    began: float,
) -> int:
    """Train, validate, and write the files. `drawn` returns the pictures that are ready."""
    folder, device, batch = arguments.folder, torch.device(arguments.device), arguments.batch
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    torch.backends.cudnn.benchmark = True
    store = Store(arguments.store, device)
    validation: list[Tensor] = []
    while store.count < max(FIRST_PICTURES * len(workers), arguments.first) or len(validation) < arguments.validation:
        time.sleep(0.05)
        for validates, pictures in drawn():
            if validates:
                validation.append(torch.from_numpy(pictures))
            else:
                store.add(pictures)
    held_out = torch.cat(validation).to(device)
    # The order in which workers finished decides nothing: figures are means over all pictures.
    network = ToolNetwork(0.0 if arguments.plain else MIXED)
    if arguments.start is not None:
        network.load_state_dict(torch.load(arguments.start / "checkpoint.pt", map_location="cpu"))
    network = network.to(device).to(memory_format=torch.channels_last)
    averaged = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(AVERAGED)
    )
    optimiser = torch.optim.AdamW(network.parameters(), arguments.rate, weight_decay=WEIGHT_DECAY)
    chance = torch.Generator(device).manual_seed(arguments.seed)
    warmed = time.monotonic()
    total = max(1.0, 60 * arguments.minutes - (warmed - began))
    print(f"{store.count} pictures after {warmed - began:.0f} s, {total:.0f} s of training", flush=True)
    kept: list[dict[str, Tensor]] = []
    log: list[dict[str, Any]] = []
    step, spent = 0, 0.0
    running = torch.zeros((), device=device)
    while (share := (time.monotonic() - warmed) / total) < 1:
        rate = arguments.rate * min(1, (step + 1) / 200) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * share)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        if step % 8 == 0:
            for _, pictures in drawn():
                store.add(pictures)
        batch_pictures, cover = store.batch(batch, chance, arguments.plain, arguments.grey)
        logits, coarse = network(features(batch_pictures).contiguous(memory_format=torch.channels_last))
        loss = loss_of(logits, cover) + COARSE * loss_of(coarse, avg_pool2d(cover, 8))
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimiser.step()
        averaged.update_parameters(network)
        step += 1
        running += 0.01 * (loss.detach() - running)
        if share * CHECKPOINTS > len(kept) + 1:
            kept.append({name: value.clone() for name, value in averaged.module.state_dict().items()})
            if spent > VALIDATION_SHARE * (time.monotonic() - warmed):
                continue
            spent -= time.monotonic()
            now = settled(averaged.module, store, batch)
            entry: dict[str, Any] = {"s": round(time.monotonic() - began), "step": step, "pictures": store.count}
            entry |= {"loss": round(float(running), 4), **validated(now, held_out)}
            log.append(entry)
            print(json.dumps(entry), flush=True)
            if share > 0.5:
                torch.save(now.state_dict(), folder / "checkpoint.pt")
            spent += time.monotonic()
    for worker in workers:
        worker.terminate()
    kept.append(averaged.module.state_dict())
    saved = [{name: halved(value) for name, value in state.items()} for state in kept[SAVED_EVERY - 1 :: SAVED_EVERY]]
    torch.save(saved, folder / "kept.pt")
    candidates = {}
    for count in LAST_CHECKPOINTS:
        if count <= len(kept):
            candidates[count] = settled(mean_of(kept[-count:]), store, batch)
    figures = {count: validated(candidate, held_out) for count, candidate in candidates.items()}
    best = max(figures, key=lambda count: figures[count]["score"])
    torch.save(candidates[best].state_dict(), folder / "checkpoint.pt")
    options = {
        name: value
        for name, value in vars(arguments).items()
        if name not in ("folder", "recordings", "export", "draw", "start", "pictures")
    }
    summary = {
        "options": options | {"with_photographs": arguments.recordings is not None},
        "torch": torch.__version__,
        "input_px": INPUT_PX,
        "inputs": INPUTS,
        "parameters": sum(part.numel() for part in network.parameters()),
        "steps": step,
        "pictures": store.count,
        "minutes": round((time.monotonic() - began) / 60, 2),
        "validation_pictures": len(held_out),
        "checkpoints": log,
        "mean_of_last": figures,
        "chosen": best,
    }
    if arguments.start is not None:
        summary["earlier"] = json.loads((arguments.start / "training.json").read_text(encoding="utf-8"))
    (folder / "training.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(f"chosen: mean of the last {best} checkpoints, {json.dumps(figures[best])}", flush=True)
    export(candidates[best], folder / "tool_network.onnx")
    return 0


if __name__ == "__main__":
    sys.exit(main())
