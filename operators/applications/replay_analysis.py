"""Analysis of a replayed frame before training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from operators.depth import DepthOp, without_depth
from operators.graph import Operator
from operators.pose import pose_operators
from operators.sources.source import SourceDescription
from operators.tool_mask import RecordedToolMaskOp

if TYPE_CHECKING:
    from operators.applications.replay import ReplayApplication, ReplaySettings


def replay_analysis(
    graph: ReplayApplication, camera: Camera, held_out: Callable[[Frame], bool], *, follows: bool
) -> Sequence[Operator]:
    """Return the operators between source and reconstruction, in order.

    Args:
        graph: graph of the replay.
        camera: camera of the frames.
        held_out: returns True for frames excluded from training.
        follows: a recorded session is replayed, whose frames already carry poses and depth.
    """
    settings = graph.settings
    # A graph that only displays a finished model does not use depth.
    learns = graph.stage == "replay"
    depth = DepthOp(
        graph, name="depth", choice="recorded" if follows else settings.depth, camera=camera, held_out=held_out,
        has_time=learns, device=settings.device,
    )  # fmt: skip
    poses = "given" if follows else settings.poses
    return RecordedToolMaskOp(graph, name="tool_mask"), *pose_operators(graph, poses, camera, settings.depth), depth


def lacking_depth(settings: ReplaySettings, source: SourceDescription, config: ReconstructorConfig) -> str | None:
    """Return a note if the source's frames have no usable recorded depth; None otherwise."""
    poses = {"pose"} if settings.poses == "estimated" else set()
    return without_depth(settings.depth, source.fields | poses, config)
