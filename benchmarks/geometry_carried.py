"""Warp the left picture into a further camera by the true depth and score it, as an upper bound for that view.

    python benchmarks/geometry_carried.py RECORDING [--every 8]

RECORDING comes from `intrasplat synthesize --third`. A reconstruction from the left eye alone can hardly score better, because highlights depend on the viewpoint.
One JSON line per view: mean PSNR over the tissue pixels that both cameras see.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np

from gsplat_core.evaluation.views import seen_by_both
from gsplat_core.io.recordings import open_recording
from gsplat_core.io.recordings.truth import open_truth
from gsplat_core.scene.cameras import inverse, moved, pixels_of, points_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--every", type=int, default=8)
    asked = parser.parse_args()
    recording = open_recording(asked.recording)
    truth = open_truth(asked.recording, recording.frame_count)
    scores = defaultdict[str, list[float]](list)
    for frame in recording:
        if frame.seq % asked.every:
            continue
        for each in truth.views:
            view = each.read(frame.seq)
            if view.depth is None:
                continue
            seen = seen_by_both(recording.camera, frame, truth.depth_of(frame), each.camera, view)
            points = moved(inverse(each.camera.world_to_camera), points_of(each.camera, view.depth))
            at = (pixels_of(recording.camera, points) - 0.5).astype(np.float32)
            carried = cv2.remap(frame.image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            error = np.square(carried.astype(np.float64) - view.image)[seen].mean()
            scores[each.name].append(float(10 * np.log10(255**2 / error)))
    for name, values in scores.items():
        print(json.dumps({"view": name, "frames": len(values), "carried_db": round(float(np.mean(values)), 2)}))


if __name__ == "__main__":
    main()
