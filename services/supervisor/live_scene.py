"""Scenes of live pictures for the layer renderer."""

from __future__ import annotations

from gsplat_core.scene.model import Model
from gsplat_core.scene.snapshots import Snapshot
from operators.messages import ShownPicture
from services.supervisor.layer_drawing import LayerScene
from services.supervisor.screen import header_of


def scene_of(shown: ShownPicture, newest: Model | Snapshot | None) -> LayerScene | None:
    """Return the scene of a live picture with the newest model. None if the sizes differ, because
    another scene has begun."""
    rendered = shown.rendered
    frame = rendered.frame
    if newest is None or (newest.camera.width_px, newest.camera.height_px) != (frame.width_px, frame.height_px):
        return None
    camera = newest.camera if frame.pose is None else newest.camera.with_pose(frame.pose)
    header = {**header_of(shown), "show": "live", "model_version": newest.version}
    planes = rendered.depth, rendered.alpha
    return LayerScene(newest, camera, frame.time_s, header, metric=frame.depth_is_metric, planes=planes)
