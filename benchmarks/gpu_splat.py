"""Measure forward and backward rendering of the peers' scenes on one NVIDIA GPU, against gsplat in the same run.

    python benchmarks/gpu_splat.py
    python benchmarks/gpu_splat.py --scenes volume1m_1080p --repetitions 100

Times the frame path (raw Gaussians in, picture out, captured as a CUDA graph) and `rasterization()`, called with gsplat's arguments. The picture is RGB and expected depth.
The loss is the mean absolute difference to a noise picture, as in the peers' measurements. Times are explained in gpu_timing.py. Prints one JSON object per line.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import torch
from gpu_scenes import SCENES, Scene
from gpu_timing import Times, Work, captured, compare, extra_mib, gsplat, measure, report, report_machine
from torch import Tensor

import gsplat_core
from gsplat_core.ops.frame import STATUS_LONGEST, STATUS_NEEDED, Frame, FrameMode, View, render_frame
from gsplat_core.ops.frame_gradients import (
    RATES,
    GaussianAdam,
    render_frame_backward,
    render_frame_backward_adam_,
)
from gsplat_core.rendering.alpha import FrameRenderer, TileListCapacity, capacity_for
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

ASKED_MS = {
    "surgical50k_640x512": (0.06, 0.30),
    "volume1m_1080p": (0.40, 1.8),
    "volume4m_4k": (1.5, 7.0),
}
"""Required times in ms: forward, and forward with backward."""
ASKED_HALF_MS = {"volume1m_1080p": 0.30, "volume4m_4k": 1.5}
"""Required times in ms: forward in half precision."""
ASKED_MIB = {"volume1m_1080p": 250.0}
"""Memory beyond what is there before (parameters, Adam's moments) for forward with backward. The gradients themselves are in it where
they are stored, as the peer's are; a training step of ours, whose Adam is in the same pass, stores none, and is what the limit is for."""


class FramePath:
    """The frame path on one scene, with the list capacity that `FrameRenderer` would choose for it."""

    def __init__(self, scene: Scene, target: Tensor) -> None:
        self._gaussians = scene.raw()
        self._half_sh = self._gaussians[4].half()
        self._view, self._target = View(*scene.camera, *scene.size_px), target
        self._capacity = 1 << 16
        status = self._training().status.tolist()
        self.instances, self.most_in_a_tile = status[STATUS_NEEDED], status[STATUS_LONGEST]
        self._lists = TileListCapacity.for_frame(self.instances, self.most_in_a_tile)
        self._capacity = capacity_for(self.instances)

    def forward(self) -> Frame:
        return self._render(self._gaussians[4])

    def forward_half(self) -> Frame:
        """Render with harmonics and blending in half precision."""
        return self._render(self._half_sh)

    def step(self) -> None:
        frame = self._training()
        render_frame_backward(
            self._gaussians, None, self._view, frame, *l1_gradients(frame.image, frame.alphas, self._target)
        )

    def learning_step(self) -> Work:
        """Run a step with the gradient fused into Adam, so that no gradient of the Gaussians is stored."""
        gaussians = tuple(tensor.clone() for tensor in self._gaussians)
        moments = [[torch.zeros_like(tensor) for tensor in gaussians] for _ in range(2)]
        rates = torch.full((RATES,), 1e-6, device="cuda")
        step = torch.ones(1, dtype=torch.int64, device="cuda")
        skipped = torch.zeros(RATES, dtype=torch.int64, device="cuda")

        def work() -> None:
            frame = self._training()
            render_frame_backward_adam_(
                gaussians, GaussianAdam(*moments, rates, step, skipped), None, self._view, frame,
                *l1_gradients(frame.image, frame.alphas, self._target), needs_raw=False,
            )  # fmt: skip

        return work

    def _render(self, sh: Tensor) -> Frame:
        return render_frame((*self._gaussians[:4], sh), None, self._view, self._lists.capacity, self._lists.mode)

    def _training(self) -> Frame:
        return render_frame(self._gaussians, None, self._view, self._capacity, FrameMode.TRAINING)


def l1_gradients(image: Tensor, alphas: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradients of the mean absolute difference of RGB and expected depth (last channel divided by alpha).

    `image` is overwritten.
    """
    weight = alphas.clamp_min(1e-10)
    depth = image[..., 3] / weight
    image[..., 3] = depth
    difference = image.sub_(target)
    torch.linalg.vector_norm(difference, 1)  # the loss itself but for a factor, which the peer takes too
    v_image = difference.sign_().mul_(1 / difference.numel())
    v_image[..., 3] /= weight
    return v_image, -(v_image[..., 3] * depth)


def called(rasterization: Callable[..., Any], scene: Scene, target: Tensor) -> tuple[Callable[[], Tensor], Work]:
    """Time forward, and forward with backward, of a function with gsplat's arguments."""

    def forward() -> Tensor:
        with torch.no_grad():
            return rasterization(**scene.arguments)[0]

    leaves = scene.leaves()

    def step() -> None:
        image, _, _ = rasterization(**(scene.arguments | leaves))
        (image - target).abs().mean().backward()
        for leaf in leaves.values():
            leaf.grad = None

    return forward, step


def live(scene: Scene, repetitions: int) -> Times:
    """Time `FrameRenderer` with a new camera per frame."""
    raw, (width, height) = scene.raw(), scene.size_px
    pose, intrinsics = (tensor.cpu().double().numpy() for tensor in scene.camera)
    cameras = []
    for k in range(16):
        pose = pose.copy()
        pose[0, 3] = 0.01 * k
        cameras.append(Camera(K=intrinsics, world_to_camera=pose, width_px=width, height_px=height))
    renderer = FrameRenderer(Gaussians(*raw), cameras[0])
    renderer.render().result()
    frame = 0

    def work() -> None:
        nonlocal frame
        frame += 1
        renderer.render(cameras[frame % len(cameras)])

    return measure(work, repetitions)


def psnr_db(a: Tensor, b: Tensor) -> float:
    return float(-10 * torch.log10((a - b)[..., :3].square().mean()))


def run(name: str, repetitions: int) -> None:
    """Measure all figures of one scene."""
    scene = SCENES[name]()
    width, height = scene.size_px
    target = torch.rand(height, width, 4, generator=torch.Generator().manual_seed(2)).cuda()
    asked_forward, asked_step = ASKED_MS.get(name, (None, None))
    peers: dict[str, tuple[Times, Times, float]] = {}
    pictures: dict[str, Tensor] = {}

    def time_called(module: str, rasterization: Callable[..., Any]) -> tuple[Times, Times, float]:
        forward, step = called(rasterization, scene, target)
        pictures[module] = forward()[0]
        return measure(forward, repetitions), measure(step, repetitions), extra_mib(step)

    if (peer := gsplat()) is not None:
        peers["gsplat"] = time_called("gsplat", peer.rasterization)
    plain = time_called("rasterization", gsplat_core.rasterization)
    path = FramePath(scene, target)
    pictures["frame path"] = path.forward().image.clone()
    near = psnr_db(path.forward_half().image, pictures["frame path"])
    works = (path.forward, path.forward_half, path.step)
    forward, half, step = (measure(captured(work), repetitions) for work in works)
    memory, learning_memory = extra_mib(path.step), extra_mib(learning := path.learning_step())
    learning_times = measure(captured(learning), repetitions)

    of_peer = lambda k: {module: figures[k] for module, figures in peers.items()}
    compare(f"{name} forward", forward, of_peer(0), asked_forward)
    asked_half = ASKED_HALF_MS.get(name)
    compare(f"{name} forward, fp16", half, of_peer(0), asked_half, psnr_to_float32_db=near)
    compare(f"{name} forward, rasterization()", plain[0], of_peer(0))
    compare(f"{name} forward+backward", step, of_peer(1), asked_step)
    compare(f"{name} forward+backward, rasterization()", plain[1], of_peer(1))
    report(f"{name} forward+backward+Adam in one", ours=learning_times)
    report(
        f"{name} forward+backward extra memory",
        ours_mib=memory,
        ours_with_adam_mib=learning_memory,
        rasterization_mib=plain[2],
        **{f"{module}_mib": figures[2] for module, figures in peers.items()},
        **({"asked_mib": ASKED_MIB[name], "met": learning_memory <= ASKED_MIB[name]} if name in ASKED_MIB else {}),
    )
    report(f"{name} FrameRenderer, a new camera every frame", ours=live(scene, repetitions))
    report(
        f"{name} agreement",
        instances=path.instances,
        most_in_a_tile=path.most_in_a_tile,
        **{
            f"psnr_to_{module}_db": psnr_db(picture, pictures["frame path"])
            for module, picture in pictures.items()
            if module != "frame path"
        },
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--repetitions", type=int, default=50)
    options = parser.parse_args()
    report_machine()
    for name in options.scenes:
        run(name, options.repetitions)
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
