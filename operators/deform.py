"""The model at a moment: deforms the Gaussians of the newest snapshot to a frame's time."""

from __future__ import annotations

from typing import Any

import torch

from operators.graph import Operator, OperatorSpec
from operators.messages import DeformedScene, Reconstruction


class DeformOp(Operator):
    """Deforms the snapshot to its frame's time and finds the camera that saw the frame.

    Inputs:
        reconstruction: `Reconstruction`.

    Outputs:
        scene: `DeformedScene`.
    """

    def setup(self, spec: OperatorSpec) -> None:
        spec.input("reconstruction", type=Reconstruction)
        spec.output("scene", type=DeformedScene)

    def compute(self, op_input: Any, op_output: Any, context: Any) -> None:
        message: Reconstruction = op_input.receive("reconstruction")
        frame, model = message.frame, message.model
        camera = model.camera if frame.pose is None else model.camera.with_pose(frame.pose)
        with torch.inference_mode():
            gaussians = model.at(frame.time_s)
        op_output.emit(DeformedScene(frame, gaussians, camera, model.version, message.trained), "scene")
