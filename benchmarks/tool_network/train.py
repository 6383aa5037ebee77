"""Train the tool network on drawn pictures and export it for `gsplat_core/endoscope/tool_network.onnx`.

One process draws pictures into a ring in a file; this process trains on random ones of them until the time is over. Backgrounds are drawn
or come from recordings whose terms allow it: `colon` (CC BY 4.0), `organ_still` and `hamlyn_pair` (BSD-3), `out_of_body` (Apache-2.0).

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
SMALL, SMALL_PX = 0.5, (80, 96)
"""First part of the time that is trained on smaller pictures, which take a third of the time, and their size."""
AVERAGED = 0.998
"""Share of the weights' running mean that a step keeps."""


def ring_in(folder: Path, mode: str) -> np.memmap:
    return np.memmap(folder / "ring.bin", np.uint8, mode, shape=(RING, *SIZE_PX, 4))


def draw(folder: Path, recordings: Path | None, seed: int, count: "mp.sharedctypes.Synchronized[int]") -> None:
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


def batch_of(rng: np.random.Generator, ring: np.memmap, there: int) -> tuple[Tensor, Tensor]:
    """Return pictures [N, 3, h, w] in 0..1 and coverage [N, 1, h / 2, w / 2] of random entries, mirrored and recoloured."""
    chosen = ring[rng.integers(0, min(there, RING), BATCH)]
    chosen = np.stack([each[:: rng.choice([-1, 1], p=[0.2, 0.8]), :: rng.choice([-1, 1])] for each in chosen])
    both = torch.from_numpy(chosen).permute(0, 3, 1, 2).float() / 255
    gains = torch.from_numpy(
        np.exp(rng.normal(0, 0.06, (BATCH, 3, 1, 1)) + rng.normal(0, 0.12, (BATCH, 1, 1, 1)))
    ).float()
    pictures = (both[:, :3] * gains).clamp(0, 1)
    return pictures, nn.functional.avg_pool2d(both[:, 3:], 2)


def loss_of(logits: Tensor, cover: Tensor) -> Tensor:
    """Return the mean of cross-entropy and soft Dice."""
    entropy = binary_cross_entropy_with_logits(logits, cover, pos_weight=torch.tensor(2.0))
    chance = torch.sigmoid(logits)
    both, sizes = (chance * cover).sum((1, 2, 3)), (chance + cover).sum((1, 2, 3))
    return entropy + 0.5 * (1 - (2 * both + 20) / (sizes + 20)).mean()


def smaller(pictures: Tensor) -> Tensor:
    return nn.functional.interpolate(pictures, SMALL_PX, mode="bilinear", antialias=True)


def settled(network: ToolNetwork, ring: np.memmap, there: int, small: bool) -> ToolNetwork:
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
            copied(features(smaller(pictures) if small else pictures))
    return copied.eval()


def export(network: ToolNetwork, path: Path) -> None:
    """Write the network as ONNX with normalisation folded into the convolutions."""
    torch.onnx.export(
        fused(network),
        (torch.zeros(1, 5, *SIZE_PX),),
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
    while count.value < 300:
        time.sleep(0.5)
    rng = np.random.default_rng(arguments.seed)
    began = saved = time.monotonic()
    step, mean = 0, 0.0
    while (share := (time.monotonic() - began) / (60 * arguments.minutes)) < 1:
        rate = arguments.rate * min(1, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * share)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        pictures, cover = batch_of(rng, ring, count.value)
        if share < SMALL:
            pictures = smaller(pictures)
            cover = nn.functional.adaptive_avg_pool2d(cover, (SMALL_PX[0] // 2, SMALL_PX[1] // 2))
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
        if time.monotonic() - saved > 120:
            saved = time.monotonic()
            torch.save(
                settled(averaged.module, ring, count.value, share < SMALL).state_dict(), folder / "checkpoint.pt"
            )
    drawing.terminate()
    final = settled(averaged.module, ring, count.value, False)
    torch.save(final.state_dict(), folder / "checkpoint.pt")
    export(final, folder / "tool_network.onnx")
    return 0


if __name__ == "__main__":
    sys.exit(main())
