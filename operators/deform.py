"""The model at a moment: finds the time and the camera of a frame, and deforms the model to it."""

from __future__ import annotations

from typing import Any

import torch

from operators.graph import Operator, OperatorSpec
from operators.messages import DeformedScene, Reconstruction


class DeformOp(Operator):
    """Deforms the model to its frame's time and finds the camera that saw the frame.

    On a GPU the deformation is part of the renderer's captured graph, and nothing is computed here.

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
                model.at(frame.time_s)  # a model remembers its last state, so the renderer finds it there
        op_output.emit(DeformedScene(frame, model, camera, message.trained, message), "scene")
