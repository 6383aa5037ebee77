"""Sessions made for tests: what is in them, and what reading them must give."""

from __future__ import annotations

import numpy as np

from gsplat_core.io.frame_codec import camera_record
from gsplat_core.io.sessions import SessionInfo, SessionWriter
from gsplat_core.io.sessions.records import Observed, Rehearsed
from gsplat_core.io.sessions.writer import Shown
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame, FrameStatus

HEIGHT_PX, WIDTH_PX = 16, 24


def session_info(width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX) -> SessionInfo:
    camera = Camera.from_focal(20.0, width_px, height_px)
    return SessionInfo(source="test", utc="2026-01-01T00:00:00+00:00", fps=30.0, camera=camera_record(camera))


def new_frame(seq: int, height_px: int = HEIGHT_PX, width_px: int = WIDTH_PX, **fields: object) -> Frame:
    """Noise, with every field set to what no default has."""
    rng = np.random.default_rng(seq)
    size = height_px, width_px
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(size=3)
    depth = rng.normal(50, 9, size).astype(np.float32)
    depth[0, 0], depth[-1, -1], depth[0, -1] = np.nan, np.inf, -0.0
    known = {
        "seq": seq,
        "pts_ns": seq * 33_333_333 + 5,
        "image": rng.integers(0, 256, (*size, 3), np.uint8),
        "right_image": rng.integers(0, 256, (*size, 3), np.uint8),
        "depth": depth,
        "depth_confidence": rng.uniform(0, 1, size).astype(np.float32),
        "depth_origin": DEPTH_ORIGINS[list(DEPTH_ORIGINS)[seq % len(DEPTH_ORIGINS)]],
        "right_camera": Camera.from_focal(20.0, width_px, height_px).right_eye(4.4),
        "mask": rng.integers(0, 2, size, np.uint8),
        "loss_mask": rng.integers(0, 2, size, np.uint8),
        "pose": pose,
        "arrived_ns": 10**15 + seq,
        "status": FrameStatus.LIVE,
        "withheld": "blur" if seq % 3 == 0 else None,
        "new_scene": "cut" if seq % 4 == 0 else None,
    }
    return Frame(**{**known, **fields})  # type: ignore[arg-type]


def same_frame(a: Frame, b: Frame) -> bool:
    """Return True if two frames are bit-identical except for `arrived_ns` and `live`, which a replay does not have."""
    planes = [
        (getattr(a, n), getattr(b, n))
        for n in ("image", "right_image", "depth", "depth_confidence", "mask", "loss_mask", "pose")
    ]
    facts = ("seq", "pts_ns", "withheld", "new_scene", "damage", "depth_origin", "right_camera")
    return all(x is y is None or x.tobytes() == y.tobytes() for x, y in planes) and all(
        getattr(a, n) == getattr(b, n) for n in facts
    )


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now_ns = 10**15

    def __call__(self) -> int:
        return self.now_ns


FRAMES = 12
PER_SEGMENT = 6


def write_frames(writer: SessionWriter, frames: list[Frame]) -> None:
    for frame in frames:
        writer.frame(frame)
        prepared = frame.with_fields(loss_mask=np.ones_like(frame.mask))
        writer.prepared(prepared, frame)
        writer.line(Observed(seq=frame.seq, steps=3, train=True))
        writer.line(Rehearsed(steps=2))
        writer.shown(
            Shown(frame, frame.image[::-1], frame.seq + 1, frame.image, shown_ns=10**15, age_ns=7, state="live")
        )
