"""Working size of an engine relative to its stream's pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gsplat_core.errors import UserError
from operators.applications.working_size import WorkingSize
from operators.settings import check_option
from operators.sources.source import SourceDescription
from services.bus.runtime import read_json, write_json
from services.errors import BadMessage
from services.supervisor.specs import EngineSpec

SHARE_OF_INTERVAL = 0.5
"""Largest share of the frame interval that processing one frame may take without viewers. Viewers,
commands and the capture process share the same cores."""


def engine_scale(
    spec: EngineSpec, about: SourceDescription, kept: Path, measure: Callable[[SourceDescription, float], WorkingSize]
) -> float:
    """Return the scale of a stream's pictures for reconstruction.

    An engine on a CPU without `engine_scale` measures once which size keeps up with the stream. A
    restarted engine reuses the stored result, to show its first picture sooner.

    Args:
        spec: engine part of the stream specification.
        about: description of the stream's pictures.
        kept: file for the measured size. An invalid file is overwritten.
        measure: returns the largest size that needs at most the given share of the frame interval.
    """
    if spec.engine_scale is not None:
        return spec.engine_scale
    if spec.device != "cpu":
        return 1.0
    size = [about.width_px, about.height_px, about.fps]
    try:
        found = read_json(kept)
        scale = float(found["scale"])
        check_option("scale", scale)
        if found["size"] == size and scale <= 1:
            return scale
    except (OSError, BadMessage, UserError, KeyError, TypeError, ValueError):
        pass  # nothing measured yet, or damaged file: measure again
    chosen = measure(about, SHARE_OF_INTERVAL)
    write_json(kept, {"size": size, "scale": chosen.scale, "frame_ms": round(1e3 * chosen.frame_s, 1)})
    return chosen.scale
