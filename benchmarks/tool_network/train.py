"""Train the tool network on drawn pictures and export it for `gsplat_core/endoscope/tool_network.onnx`.

One process draws pictures into a ring in a file; this process trains on random ones of them until the time is over. Backgrounds are drawn
or come from recordings whose terms allow it: `colon` (CC BY 4.0), `organ_still` and `hamlyn_pair` (BSD-3), `out_of_body` (Apache-2.0).

The weights are averaged over the checkpoints of the whole run. Longer training on the same pictures lowers the loss on drawn pictures and
finds less in real ones; the mean of checkpoints does not. Continue a run with --start if two cores are too few for one run.

Usage: python -m benchmarks.tool_network.train FOLDER [--recordings DIR] [--minutes 30] [--start CHECKPOINT] [--seed 0]
The folder receives `checkpoint.pt` every two minutes and `tool_network.onnx` at the end.
"""

from __future__ import annotations

import argparse
import copy
import math
import multiprocessing as mp
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from benchmarks.tool_network.network import ToolNetwork, features, fused
from benchmarks.tool_network.pictures import SIZE_PX, training_picture
from benchmarks.tool_network.tissue import Photographs, TissuePool

RING = 8000
"""Pictures that are kept; older ones are replaced."""
BATCH = 16
LEARNING_RATE = 2.5e-3
INPUT_PX = (80, 96)
"""Height and width of the network's input."""
CHECKPOINT_S = 120
"""Time between checkpoints."""
AVERAGED = 0.998
"""Share of the weights' running mean that a step keeps."""


def ring_in(folder: Path, mode: str) -> np.memmap:
    return np.memmap(folder / "ring.bin", np.uint8, mode, shape=(RING, *SIZE_PX, 4))


def draw(folder: Path, recordings: Path | None, seed: int, count: mp.sharedctypes.Synchronized[int]) -> None:
    """Draw pictures until the process is ended."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(seed)
    photographs = Photographs(recordings) if recordings is not None else None
    pool = TissuePool(photographs)
    ring = ring_in(folder, "r+")
    while True:
        image, mask = training_picture(rng, pool)
        at = count.value % RING
        ring[at, ..., :3], ring[at, ..., 3] = image, mask
        count.value += 1


def batch_of(rng: np.random.Generator, ring: np.memmap, there: int, pasted: float = 0.5) -> tuple[Tensor, Tensor]:
    """Return pictures [N, 3, h, w] in 0..1, of `INPUT_PX`, and their coverage by tools [N, 1, h / 2, w / 2].

    Random entries of the ring are mirrored, turned, scaled and recoloured, and a share of `pasted` gets the tools of another one.
    Drawing takes longer than training, so the pictures would be learned by heart otherwise.
    """
    chosen = ring[rng.integers(0, min(there, RING), BATCH)]
    chosen = np.stack([each[:: rng.choice([-1, 1], p=[0.2, 0.8]), :: rng.choice([-1, 1])] for each in chosen])
    both = reduced(torch.from_numpy(chosen).permute(0, 3, 1, 2).float() / 255)
    normal = lambda spread, *shape: torch.from_numpy(np.exp(rng.normal(0, spread, (BATCH, *shape, 1, 1)))).float()
    pictures, cover = recoloured(both[:, :3], normal), both[:, 3:]
    others = rng.permutation(BATCH)
    layer = cover[others] * torch.from_numpy(rng.random((BATCH, 1, 1, 1)) < pasted)
    pictures = pictures + layer * (pictures[others] - pictures)
    cover = torch.maximum(cover, layer)
    angle, scale = rng.normal(0, 0.25, BATCH), np.exp(rng.normal(0, 0.2, BATCH))
    aspect = INPUT_PX[1] / INPUT_PX[0]
    turns = np.zeros((BATCH, 2, 3), np.float32)
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle) * scale
    turns[:, 0, 1], turns[:, 1, 0] = -np.sin(angle) * scale / aspect, np.sin(angle) * scale * aspect
    turns[:, :, 2] = rng.normal(0, 0.12, (BATCH, 2))
    grid = nn.functional.affine_grid(torch.from_numpy(turns), [BATCH, 4, *INPUT_PX], align_corners=False)
    moved = nn.functional.grid_sample(
        torch.cat([pictures, cover], 1), grid, padding_mode="reflection", align_corners=False
    )
    return recoloured(moved[:, :3], normal), nn.functional.avg_pool2d(moved[:, 3:], 2)


def recoloured(pictures: Tensor, normal: Callable[..., Tensor]) -> Tensor:
    """Return pictures with other white balance, brightness, gamma and saturation."""
    pictures = (pictures * normal(0.06, 3) * normal(0.12, 1)).clamp(1e-4, 1) ** normal(0.15, 1)
    grey = pictures.mean(1, keepdim=True)
    return (grey + (pictures - grey) * normal(0.12, 1)).clamp(0, 1)


def loss_of(logits: Tensor, cover: Tensor) -> Tensor:
    """Return the mean of cross-entropy and soft Dice."""
    entropy = binary_cross_entropy_with_logits(logits, cover, pos_weight=torch.tensor(2.0))
    chance = torch.sigmoid(logits)
    both, sizes = (chance * cover).sum((1, 2, 3)), (chance + cover).sum((1, 2, 3))
    return entropy + 0.5 * (1 - (2 * both + 20) / (sizes + 20)).mean()


def reduced(pictures: Tensor) -> Tensor:
    return nn.functional.interpolate(pictures, INPUT_PX, mode="bilinear", antialias=True)


def mean_of(states: list[dict[str, Tensor]]) -> ToolNetwork:
    """Return a network with the mean of weights."""
    network = ToolNetwork()
    network.load_state_dict(
        {name: sum(state[name].float() for state in states) / len(states) for name in states[0]}  # type: ignore[misc]
    )
    return network


def settled(network: ToolNetwork, ring: np.memmap, there: int) -> ToolNetwork:
    """Return a copy whose normalisations have the statistics of the mean weights, which a mean of statistics is not."""
    copied = copy.deepcopy(network).train()
    for part in copied.modules():
        if isinstance(part, nn.BatchNorm2d):
            part.reset_running_stats()
            part.momentum = None
    rng = np.random.default_rng(0)
    with torch.no_grad():
        for _ in range(40):
            pictures, _ = batch_of(rng, ring, there)
            copied(features(pictures))
    return copied.eval()


def export(network: ToolNetwork, path: Path) -> None:
    """Write the network as ONNX with normalisation folded into the convolutions."""
    torch.onnx.export(
        fused(network),
        (torch.zeros(1, 5, *INPUT_PX),),
        str(path),
        input_names=["features"],
        output_names=["tool"],
        dynamo=False,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=LEARNING_RATE)
    arguments = parser.parse_args()
    folder: Path = arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    ring = ring_in(folder, "w+")
    count = mp.get_context("fork").Value("q", 0, lock=False)
    drawing = mp.get_context("fork").Process(
        target=draw, args=(folder, arguments.recordings, arguments.seed + 1, count), daemon=True
    )
    drawing.start()
    network = ToolNetwork().to(memory_format=torch.channels_last)
    if arguments.start is not None:
        network.load_state_dict(torch.load(arguments.start))
    averaged = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(AVERAGED)
    )
    optimiser = torch.optim.AdamW(network.parameters(), arguments.rate, weight_decay=1e-3)
    while count.value < 1200:
        time.sleep(0.5)
    rng = np.random.default_rng(arguments.seed)
    began = saved = time.monotonic()
    step, mean = 0, 0.0
    kept: list[dict[str, Tensor]] = []
    while (share := (time.monotonic() - began) / (60 * arguments.minutes)) < 1:
        rate = arguments.rate * min(1, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * share)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        pictures, cover = batch_of(rng, ring, count.value)
        loss = loss_of(network(features(pictures).contiguous(memory_format=torch.channels_last)), cover)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 2.0)
        optimiser.step()
        averaged.update_parameters(network)
        step += 1
        mean += 0.02 * (float(loss.detach()) - mean)
        if step % 100 == 0:
            print(
                f"{60 * arguments.minutes * share:.0f} s, step {step}, {count.value} pictures, loss {mean:.4f}",
                flush=True,
            )
        if time.monotonic() - saved > CHECKPOINT_S:
            saved = time.monotonic()
            kept.append(copy.deepcopy(averaged.module.state_dict()))
            torch.save(settled(mean_of(kept), ring, count.value).state_dict(), folder / "checkpoint.pt")
    drawing.terminate()
    final = settled(mean_of([*kept, averaged.module.state_dict()]), ring, count.value)
    torch.save(final.state_dict(), folder / "checkpoint.pt")
    export(final, folder / "tool_network.onnx")
    return 0


if __name__ == "__main__":
    sys.exit(main())
