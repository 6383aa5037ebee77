"""Make the moving picture of the README: recorded frame, reconstruction, and the model seen from an orbit.

    python benchmarks/moving_picture.py out/moving_picture docs/pictures/demo.webp

Runs `intrasplat synthesize`, `replay` and `render --view orbit` in the folder, and joins their videos. Results that the folder
already holds are used again. The recording takes 4 s, the time of one orbit, so the orbit closes where the picture repeats.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

FPS = 30
FRAMES = 4 * FPS
EVERY = 2
"""Frames of the videos for each frame of the picture."""
QUALITY = 85
"""Quality of WebP, 1 to 100."""


def run(result: Path, *words: str) -> None:
    """Run an `intrasplat` command unless its result exists."""
    if not result.exists():
        subprocess.run([sys.executable, "-m", "services.cli", *words], check=True)


def frames(video: Path) -> list[NDArray[np.uint8]]:
    """Return every `EVERY`th frame of a video, BGR uint8 [H, W, 3]."""
    reader = cv2.VideoCapture(str(video))
    found = []
    while (read := reader.read())[0]:
        found.append(np.asarray(read[1], np.uint8))
    return found[::EVERY]


def with_caption(image: NDArray[np.uint8], height: int, text: str) -> NDArray[np.uint8]:
    """Return the image below a caption, `height` pixels high in total, in the style of the replay's video."""
    strip = height - image.shape[0]
    canvas = np.full((height, image.shape[1], 3), (26, 20, 16), np.uint8)
    canvas[strip:] = image
    cv2.putText(canvas, text, (8, strip - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (230, 230, 230), 1, cv2.LINE_AA)
    return canvas


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="results of the commands")
    parser.add_argument("picture", type=Path, help="the WebP file to write")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    recording, run_folder, orbit = options.folder / "recording", options.folder / "run", options.folder / "orbit.mp4"
    run(recording, "synthesize", "--out", str(recording), "--frames", str(FRAMES))
    replay = ["replay", str(recording), "--out", str(run_folder), "--depth", "stereo", "--device", options.device]
    run(run_folder, *replay)
    run(orbit, "render", str(run_folder / "model"), "--view", "orbit", "--out", str(orbit), "--fps", str(FPS))

    pairs, views = frames(run_folder / "reconstruction.mp4"), frames(orbit)
    height = pairs[0].shape[0]
    animation = cv2.Animation()
    animation.frames = [
        np.hstack([pair, with_caption(view, height, "model, seen from an orbit")])
        for pair, view in zip(pairs, views, strict=True)
    ]
    animation.durations = np.full(len(pairs), 1000 * EVERY // FPS)
    if not cv2.imwriteanimation(str(options.picture), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise SystemExit(f"{options.picture} could not be written; give a file name that ends in .webp")
    print(f"{options.picture}: {len(pairs)} frames, {options.picture.stat().st_size / 2**20:.2f} MiB")


if __name__ == "__main__":
    main()
