"""The CUDA kernels on a machine that may have no GPU: every op that the sources implement is registered, and shapes can be traced."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
from pathlib import Path

import pytest
import torch
from torch._subclasses import FakeTensorMode
from torch.fx.experimental.symbolic_shapes import ShapeEnv

import gsplat_core.ops
from gsplat_core.ops import native
from gsplat_core.ops.arguments import TileGrid
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.frame import FrameMode, View, render_frame
from gsplat_core.ops.frame_gradients import (
    GaussianAdam,
    render_frame_backward,
    render_frame_backward_adam_,
)
from gsplat_core.ops.image_loss import frame_loss
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles import bin_splats

N = 10

ROOT = Path(native.__file__).resolve().parent
SCHEMAS = re.findall(r"\bm\.def\(\s*\"(\w+)\(", (ROOT.parent / "native" / "schemas.cpp").read_text())
WITHOUT_CUDA = {
    "active_isa", "surface_motion", "neighbour_motion", "neighbour_motion_backward", "correct_colours", "bundle_cost", "bundle_equations",
    "place_camera", "sweep_planes", "select_planes",
}  # fmt: skip
"""`active_isa` has nothing to do with a device, colours are corrected in advance on the CPU only (`correct_colours`), and camera poses are
estimated there (`bundle_adjustment`), as is depth by parallax (`plane_sweep`). On a GPU plain torch computes
the other ones: `surface_motion` for the start from motion, and `neighbour_motion` for optical flow. Another op without a CUDA kernel was forgotten."""


def implemented(device: str) -> set[str]:
    """Names that the sources register kernels for on a device: host files are compiled for both, but those of one device alone."""
    other = "cuda" if device == "CPU" else "cpu"
    blocks = (
        block
        for path in sorted(ROOT.rglob("*.cpp"))
        if not path.name.endswith(f"_{other}_host.cpp")
        for block in re.findall(
            rf"STABLE_TORCH_LIBRARY_IMPL\(gsplat_core, (?:{device}|GSPLAT_DEVICE), m\) {{(.*?)}}",
            sources(path, device),
            re.S,
        )
    )
    return {name for block in blocks for name in re.findall(r"m\.impl\(\"(\w+)\"", block)}


def sources(path: Path, device: str) -> str:
    """A file without what is left out for a device."""
    text = path.read_text()
    return text if device == "CPU" else re.sub(r"#if !defined\(GSPLAT_CUDA\)\n.*?#endif", "", text, flags=re.S)


def has_kernel(name: str, key: str) -> bool:
    return torch._C._dispatch_has_kernel_for_dispatch_key(f"gsplat_core::{name}", key)


@pytest.fixture(scope="module", autouse=True)
def all_ops_imported() -> None:
    """The fake kernels are registered by the ops' Python modules."""
    for module in pkgutil.walk_packages(gsplat_core.ops.__path__, "gsplat_core.ops."):
        importlib.import_module(module.name)


@pytest.fixture
def cuda_library() -> None:
    """The library, with or without a GPU: skipped where it was not built, unless CI says that it must be."""
    if native.CUDA_MISSING is None:
        return
    if os.environ.get("INTRASPLAT_REQUIRE_CUDA_BUILD") == "1":
        pytest.fail(f"the CUDA kernels are required here and are {native.CUDA_MISSING}")
    pytest.skip(f"the CUDA kernels are {native.CUDA_MISSING}")


@pytest.mark.slow
def test_cuda_sources_implement_ops_with_schema():
    on_cuda = implemented("CUDA")
    assert len(on_cuda) >= 12
    assert on_cuda <= set(SCHEMAS)
    assert set(SCHEMAS) - on_cuda == WITHOUT_CUDA


def test_every_cuda_kernel_in_sources_is_registered(cuda_library):
    missing = {name for name in implemented("CUDA") if not has_kernel(name, "CUDA")}
    assert not missing


def test_cuda_build_string_names_compiler_and_targets(cuda_library):
    assert re.fullmatch(r"nvcc \d+\.\d+ for \d+\.\d(, \d+\.\d)*", native.cuda_build())


def test_ci_cuda_build_targets_newest_architecture(cuda_library):
    if os.environ.get("INTRASPLAT_REQUIRE_CUDA_BUILD") != "1":
        pytest.skip("only where CI has built it: others build for the GPU at hand")
    assert native.cuda_build().endswith(" for 9.0"), "one file is compiled for earlier GPUs as well, see .ci/run"


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SCHEMAS if name != "active_isa"])
def test_every_op_has_a_fake_kernel(name):
    assert has_kernel(name, "Meta")


def test_image_ops_traced_on_cuda_without_gpu(cuda_library):
    """The ops of a plain render, forward and backward: shapes and devices from the fake kernels alone."""
    with FakeTensorMode(shape_env=ShapeEnv()):
        means, quats, scales, opacities, sh = gaussians(9)
        view = (floats(1, 4, 4), floats(1, 3, 3), 64, 48)
        rows = fully_fused_projection(means, None, quats, scales, *view, opacities=opacities)
        colors = spherical_harmonics(2, means[None], sh)
        splats = (rows.means2d, rows.conics, colors, opacities[None])
        _, flatten_ids, offsets = bin_splats(
            rows.means2d, rows.radii, rows.depths, TileGrid(16, 4, 3), conics=rows.conics, opacities=splats[3]
        )
        assert flatten_ids.is_cuda and offsets.shape == (1, 3, 4)
        image, alphas = rasterize_to_pixels(*splats, 64, 48, 16, offsets, flatten_ids)
        assert image.shape == (1, 48, 64, 3) and alphas.is_cuda
        # Their gradients, by the ops: autograd's engine itself needs the device.
        ops = torch.ops.gsplat_core
        flat = [tensor.reshape(N, *tensor.shape[2:]) for tensor in splats]
        last = floats(1, 48, 64, dtype=torch.int32)
        gradients = ops.composite_backward(
            *flat, offsets, flatten_ids, None, None, 64, 48, 16, alphas[..., 0], last, image, alphas[..., 0], False
        )
        assert [gradient.shape for gradient in gradients[:4]] == [tensor.shape for tensor in flat]
        v_dirs, v_sh = ops.spherical_harmonics_backward(2, means[None], sh, None, colors, True)
        assert v_dirs.shape == (1, N, 3) and v_sh.shape == sh.shape and v_sh.is_cuda
        v_means, _, v_quats, v_scales, _ = ops.project_gaussians_backward(
            means[None], None, quats[None], scales[None], view[0][None], view[1][None], rows.radii[None], *gradients[:1],
            rows.depths[None], gradients[1], None, 64, 48, 0.3, 0, False,
        )  # fmt: skip
        assert (v_means.shape, v_quats.shape, v_scales.shape) == ((1, N, 3), (1, N, 4), (1, N, 3)) and v_means.is_cuda


@pytest.mark.slow
def test_frame_and_gradient_traced_on_cuda_without_gpu(cuda_library):
    with FakeTensorMode():
        raw = gaussians(16)
        deltas, view = floats(N, 16), View(floats(4, 4), floats(3, 3), 64, 48)
        frame = render_frame(raw, deltas, view, 1000, FrameMode.TRAINING)
        assert frame.image.shape == (48, 64, 4) and frame.records.shape == (N, 12) and frame.sorted.shape == (1000,)
        loss = frame_loss(frame.image, frame.alphas, floats(48, 64, 3, dtype=torch.uint8), None, None, 0.2, 0.0)
        assert loss.loss.shape == () and loss.grad_image.shape == frame.image.shape
        gradients = render_frame_backward(raw, deltas, view, frame, loss.grad_image, loss.grad_alphas)
        assert gradients.raw.shape == (N, 16) and gradients.sh.shape == (N, 16, 3) and gradients.sh.is_cuda


@pytest.mark.parametrize("bases", [1, 4])
def test_frame_adam_traced_on_cuda_without_gpu(cuda_library, bases):
    with FakeTensorMode():
        raw, first, second = gaussians(bases), gaussians(bases), gaussians(bases)
        view = View(floats(4, 4), floats(3, 3), 64, 48, floats(3))
        frame = render_frame(raw, None, view, 1000, FrameMode.TRAINING)
        adam = GaussianAdam(first, second, floats(5), floats(1, dtype=torch.int64), floats(5, dtype=torch.int64))
        raw_gradient = render_frame_backward_adam_(raw, adam, None, view, frame, frame.image, frame.alphas)
        assert raw_gradient is not None and raw_gradient.shape == (N, 16)


def floats(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="cuda")


def gaussians(bases: int) -> tuple[torch.Tensor, ...]:
    return floats(N, 3), floats(N, 4), floats(N, 3), floats(N), floats(N, bases, 3)
