"""Deformation of the model to a frame's timestamp, with the camera of that frame."""

from __future__ import annotations

from typing import Any

import torch

from operators.graph import Operator, OperatorSpec
from operators.messages import DeformedScene, Reconstruction


class DeformOp(Operator):
    """Deforms the model to its frame's timestamp and sets the camera to the frame's pose.

    On a GPU the renderer's captured graph performs the deformation, so this operator only selects
    the camera.

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
        if model.device.type == "cpu":
            with torch.inference_mode():
                model.at(frame.time_s)  # caches the state inside the model; the renderer reuses it
        op_output.emit(DeformedScene(frame, model, camera, message.trained, message), "scene")
