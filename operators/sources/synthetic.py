"""Endless source of the project's synthetic scene."""

from __future__ import annotations

import logging
from dataclasses import replace

from gsplat_core.io.recordings.synthetic.rendered import RenderSettings, kept_recording
from operators.sources.address import SourceOptions, SyntheticAddress
from operators.sources.recording import RealtimeSource

log = logging.getLogger(__name__)
DEFAULT_FRAMES = 48
MOST_BYTES = 512 * 2**20
"""Maximum size in bytes of the rendered frames, which are played forwards and backwards."""


def synthetic_source(rest: str, options: SourceOptions) -> RealtimeSource:
    """Open `synthetic:?width=640&height=512&fps=30&seed=0&frames=48&moving=1&eyes=1`.

    Ray casting is slower than real time, so `frames` frames are rendered first and then played forwards and backwards.
    They are cached for later runs. Raises InvalidSetting for options out of range.
    """
    address = SyntheticAddress.parse(rest, options)
    width, height = (max(32, round(side * options.scale)) for side in (address.width_px, address.height_px))
    per_frame = width * height * (8 if address.eyes == 1 else 11)
    fits = max(1, MOST_BYTES // per_frame)
    settings = RenderSettings(
        frames=min(address.frames or DEFAULT_FRAMES, fits),
        width_px=width,
        height_px=height,
        fps=address.fps,
        seed=address.seed,
        camera="moving" if address.moving else "fixed",
        stereo=address.eyes == 2,
    )
    recording = kept_recording(settings, progress=_say)
    return RealtimeSource(recording, replace(options, loop=True, bounce=recording.frame_count > 2, fps=None))


def _say(done: int, frames: int) -> None:
    if done == 1 or done % 10 == 0 or done == frames:
        log.info("synthetic: rendered %d of %d frames", done, frames)
