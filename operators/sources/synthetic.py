"""Endless source of the project's synthetic scene."""

from __future__ import annotations

import logging
from dataclasses import replace

from gsplat_core.io.recordings.synthetic.kept import kept_recording
from gsplat_core.io.recordings.synthetic.rendered import Asked
from gsplat_core.io.recordings.synthetic.synthesize import MAX_SEED
from operators.sources.address import Address
from operators.sources.options import SourceOptions
from operators.sources.realtime import RealtimeSource

log = logging.getLogger(__name__)
DEFAULT_FRAMES = 48
MOST_FRAMES = 1000
MOST_BYTES = 512 * 2**20
"""Maximum size in bytes of the rendered frames, which are played forwards and backwards."""


def synthetic_source(rest: str, options: SourceOptions) -> RealtimeSource:
    """Open `synthetic:?width=640&height=512&fps=30&seed=0&frames=48&moving=1&eyes=1`.

    Ray casting is slower than real time, so `frames` frames are rendered first and then played
    forwards and backwards. They are cached for later runs. Raises InvalidSetting for options out of
    range.
    """
    address = Address.parse("synthetic", rest)
    width = address.whole("width", 640, 32, 4096)
    height = address.whole("height", 512, 32, 4096)
    fps = address.number("fps", options.fps or 30.0, 1, 240)
    seed = address.whole("seed", 0, 0, MAX_SEED)
    moving = address.flag("moving")
    eyes = address.whole("eyes", 1, 1, 2)
    most = address.whole("frames", None, 1, MOST_FRAMES)
    address.refuse_others()
    assert width is not None and height is not None and seed is not None
    width, height = max(32, round(width * options.scale)), max(32, round(height * options.scale))
    per_frame = width * height * (8 if eyes == 1 else 11)
    fits = max(1, MOST_BYTES // per_frame)
    asked = Asked(
        frames=min(most or DEFAULT_FRAMES, fits),
        width_px=width,
        height_px=height,
        fps=fps,
        seed=seed,
        camera="moving" if moving else "fixed",
        stereo=eyes == 2,
    )
    recording = kept_recording(asked, progress=_say)
    return RealtimeSource(recording, replace(options, loop=True, bounce=recording.frame_count > 2, fps=None))


def _say(done: int, frames: int) -> None:
    if done == 1 or done % 10 == 0 or done == frames:
        log.info("synthetic: rendered %d of %d frames", done, frames)
