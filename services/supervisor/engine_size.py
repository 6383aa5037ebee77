"""Size of what an engine reconstructs, beside its stream's pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gsplat_core.errors import UserError
from operators.applications.limits import check_scale
from operators.applications.working_size import WorkingSize
from operators.sources.source import SourceDescription
from services.bus.errors import BadMessage
from services.bus.runtime import read_json, write_json
from services.supervisor.specs import EngineSpec

SHARE_OF_INTERVAL = 0.5
"""Largest share of the time between two frames that a frame may take, while nobody watches. Viewers, commands and the capture process need
the rest of the same cores."""


def engine_scale(
    spec: EngineSpec, about: SourceDescription, kept: Path, measure: Callable[[SourceDescription, float], WorkingSize]
) -> float:
    """Return what a stream's pictures are scaled by before they are reconstructed.

    An engine on a CPU without `engine_scale` measures once what the machine keeps up with. One that is started again takes the size that the one
    before it measured, so that its first picture comes soon.

    Args:
        about: the stream's pictures.
        kept: file in which the measured size is kept; it is written, and a file that is no such size is replaced.
        measure: returns the largest size that takes a share of the time between frames.
    """
    if spec.engine_scale is not None:
        return spec.engine_scale
    if spec.device != "cpu":
        return 1.0
    size = [about.width_px, about.height_px, about.fps]
    try:
        found = read_json(kept)
        scale = float(found["scale"])
        check_scale(scale)
        if found["size"] == size and scale <= 1:
            return scale
    except (OSError, BadMessage, UserError, KeyError, TypeError, ValueError):
        pass  # nothing was measured yet, or the file is damaged: the size is measured and written anew
    chosen = measure(about, SHARE_OF_INTERVAL)
    write_json(kept, {"size": size, "scale": chosen.scale, "frame_ms": round(1e3 * chosen.frame_s, 1)})
    return chosen.scale
