"""All of `rasterization()` on CUDA in one native call per pass: project, colour, sort and blend (Kerbl et al. 2023).

Two autograd nodes, so that programs can look between them: `_Project` (Gaussians to splats) and `_Blend` (splats to the picture),
with `means2d` on the way from one to the other. The forward pass of both is the one call that `_Project` makes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsplat_core.ops import native  # noqa: F401  registers the compiled ops

PLAIN_COLORS = -1
"""In place of a degree: colours are taken as they are, at most `MOST_PLAIN_COLORS` of them."""
MOST_PLAIN_COLORS = 3
NO_DEPTH, DEPTH_SUM, EXPECTED_DEPTH = range(3)
TILE_SIZE = 16
MOST_PIXELS = 16 << 13
"""Largest width and height of a picture."""

_FORWARD = torch.ops.gsplat_core.rasterize.default
_SPLATS_BACKWARD = torch.ops.gsplat_core.rasterize_splats_backward.default
_INPUTS_BACKWARD = torch.ops.gsplat_core.rasterize_inputs_backward.default


class View(NamedTuple):
    """What is not a tensor."""

    image_dims: tuple[int, ...]
    """Batch dimensions and number of cameras."""
    width: int
    height: int
    camera_model: int
    """Index into CAMERA_MODELS."""
    degree: int
    """0 to 4, or PLAIN_COLORS."""
    channels: int
    """Colours in the picture, 0 to 3."""
    depth_mode: int
    antialiased: bool
    packed: bool
    absgrad: bool
    eps2d: float
    near_plane: float
    far_plane: float
    radius_clip: float


class Inputs(NamedTuple):
    """Tensors, float32 on one CUDA device; batch dimensions as in `rasterization()`."""

    means: Tensor
    covars: Tensor | None
    """Upper triangles [..., N, 6], or None with the next two given."""
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    """[..., (C,) N, K, 3] or [..., (C,) N, D]; None where no colour is rendered."""
    viewmats: Tensor
    Ks: Tensor
    centers: Tensor | None
    """[..., C, 3]: the cameras' centres, where their gradient is wanted; else they are computed from the matrices."""


class Rasterized(NamedTuple):
    """What the forward pass returns; `opacities` is empty unless antialiased or packed, the ids are None unless packed."""

    image: Tensor
    alphas: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor
    opacities: Tensor
    radii: Tensor
    tiles_per_gauss: Tensor
    isect_offsets: Tensor
    flatten_ids: Tensor
    isect_ids: Tensor
    batch_ids: Tensor | None = None
    camera_ids: Tensor | None = None
    gaussian_ids: Tensor | None = None


class _Call:
    """One forward pass on its way through the two nodes."""

    __slots__ = ("outputs", "view")

    def __init__(self, view: View) -> None:
        self.view = view
        self.outputs: list[Tensor] = []


def rasterize(inputs: Inputs, backgrounds: Tensor | None, view: View, differentiable: bool) -> Rasterized:
    """Render; the caller has checked shapes, types and devices. `backgrounds`: [..., C, channels].

    The host waits once, for the length of the tiles' lists. The same inputs give the same bits, forward and backward.
    """
    if not differentiable:
        return _named(_run(inputs, backgrounds, view, False), view)
    call = _Call(view)
    means2d, depths, conics, opacities, records = _Project.apply(call, backgrounds, *inputs)
    image, alphas = _Blend.apply(call, means2d, records, backgrounds)
    out = _named(call.outputs, view)
    return out._replace(image=image, alphas=alphas, means2d=means2d, depths=depths, conics=conics, opacities=opacities)


def _run(inputs: tuple[Any, ...], backgrounds: Tensor | None, view: View, training: bool) -> list[Tensor]:
    return _FORWARD(
        *inputs, backgrounds, view.image_dims, view.width, view.height, view.camera_model, view.degree, view.depth_mode,
        view.antialiased, view.packed, training, view.eps2d, view.near_plane, view.far_plane, view.radius_clip,
    )  # fmt: skip


def _named(outputs: list[Tensor], view: View) -> Rasterized:
    return Rasterized(*outputs[: 14 if view.packed else 11])


class _Project(Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, backgrounds: Tensor | None, *inputs: Any) -> tuple[Tensor, ...]:
        view = call.view
        call.outputs = out = _run(inputs, backgrounds, view, True)
        ctx.view = view
        ctx.set_materialize_grads(False)
        # records, splat_starts, sorted, last, expected, and packed: row_of, dense radii, splat_ids
        own = out[14:] if view.packed else out[11:]
        row_of, radii = (own[5], own[6]) if view.packed else (None, out[6])
        ctx.save_for_backward(*inputs, radii, row_of)
        return out[2], out[3], out[4], out[5], own[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
        v_means2d, v_depths, v_conics, v_opacities, v_splats = v
        view: View = ctx.view
        needs = ctx.needs_input_grad
        *inputs, radii, row_of = ctx.saved_tensors
        wanted = [*needs[2:8], needs[8], needs[10]]
        if not view.channels:
            wanted[5] = False
        if v_opacities is not None and not v_opacities.numel():
            v_opacities = None
        out = _INPUTS_BACKWARD(
            *inputs, radii, row_of, [v_splats, v_means2d, v_depths, v_conics, v_opacities], view.image_dims, view.width,
            view.height, view.camera_model, view.degree, view.depth_mode, view.antialiased, view.eps2d, wanted,
        )  # fmt: skip
        g = [gradient if want else None for gradient, want in zip(out, wanted, strict=True)]
        return None, None, *g[:7], None, g[7]


class _Blend(Function):
    @staticmethod
    def forward(
        ctx: Any, call: _Call, means2d: Tensor, records: Tensor, backgrounds: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        view, out = call.view, call.outputs
        image, alphas = out[0], out[1]
        own = out[14:] if view.packed else out[11:]
        row_of, splat_ids = (own[5], own[7]) if view.packed else (None, out[9])
        ctx.view = view
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(
            records, out[4], out[8], splat_ids, own[2], own[1], row_of, backgrounds, alphas, own[4], own[3],
            means2d if view.absgrad else None,
        )  # fmt: skip
        return image, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None) -> tuple[Tensor | None, ...]:
        view: View = ctx.view
        *saved, means2d = ctx.saved_tensors
        _, needs_means2d, needs_records, needs_backgrounds = ctx.needs_input_grad
        v_means2d = v_records = v_backgrounds = None
        if needs_backgrounds and v_image is not None:
            alphas = saved[8]
            v_backgrounds = (v_image[..., : view.channels] * (1 - alphas)).sum((-3, -2))
        if needs_means2d or needs_records:
            v_records, v_means2d, absolute = _SPLATS_BACKWARD(
                *saved, v_image, v_alphas, view.image_dims, view.width, view.height, view.channels, view.depth_mode,
                view.absgrad,
            )  # fmt: skip
            if means2d is not None:
                means2d.absgrad = absolute
        return None, v_means2d, v_records, v_backgrounds


@torch.library.register_fake("gsplat_core::rasterize")
def _fake(
    means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, opacities: Tensor,
    colors: Tensor | None, viewmats: Tensor, Ks: Tensor, centers: Tensor | None, backgrounds: Tensor | None,
    image_dims: list[int], width: int, height: int, camera_model: int, degree: int, depth_mode: int, antialiased: bool,
    packed: bool, training: bool, eps2d: float, near_plane: float, far_plane: float, radius_clip: float,
) -> list[Tensor]:  # fmt: skip
    n, size = means.shape[-2], torch.library.get_ctx().new_dynamic_size
    images, length = torch.Size(image_dims).numel(), size()
    channels = 0 if colors is None else int(colors.shape[-1])
    floats = lambda *shape: means.new_empty(shape)
    ints = lambda *shape: means.new_empty(shape, dtype=torch.int32)
    longs = lambda *shape: means.new_empty(shape, dtype=torch.int64)
    rows = (size(),) if packed else (*image_dims, n)
    tiles = (-(-height // TILE_SIZE), -(-width // TILE_SIZE))
    out = [
        floats(*image_dims, height, width, channels + (depth_mode != NO_DEPTH)), floats(*image_dims, height, width, 1),
        floats(*rows, 2), floats(*rows), floats(*rows, 3), floats(*rows) if packed or antialiased else floats(0),
        ints(*rows, 2), ints(*rows), ints(*image_dims, *tiles), ints(length), longs(length),
    ]  # fmt: skip
    if packed:
        out += [longs(*rows) for _ in range(3)]
    if training:
        expected = floats(*image_dims, height, width) if depth_mode == EXPECTED_DEPTH else floats(0)
        out += [floats(images * n, 12), ints(images * n + 1), ints(length), ints(*image_dims, height, width), expected]
    if training and packed:
        out += [ints(images * n), ints(*image_dims, n, 2), ints(length)]
    return out


@torch.library.register_fake("gsplat_core::rasterize_splats_backward")
def _fake_splats_backward(
    records: Tensor, conics: Tensor, isect_offsets: Tensor, splat_ids: Tensor, sorted: Tensor, splat_starts: Tensor,
    row_of: Tensor | None, backgrounds: Tensor | None, alphas: Tensor, expected: Tensor | None, last: Tensor,
    v_image: Tensor | None, v_alphas: Tensor | None, image_dims: list[int], width: int, height: int, channels: int,
    depth_mode: int, absolute: bool,
) -> tuple[Tensor, ...]:  # fmt: skip
    rows = (*conics.shape[:-1], 2)
    return records.new_empty(records.shape), conics.new_empty(rows), conics.new_empty(rows if absolute else (0,))


@torch.library.register_fake("gsplat_core::rasterize_inputs_backward")
def _fake_inputs_backward(
    means: Tensor, covars: Tensor | None, quats: Tensor | None, scales: Tensor | None, opacities: Tensor,
    colors: Tensor | None, viewmats: Tensor, Ks: Tensor, centers: Tensor | None, radii: Tensor, row_of: Tensor | None,
    gradients: list[Tensor | None], image_dims: list[int], width: int, height: int, camera_model: int, degree: int,
    depth_mode: int, antialiased: bool, eps2d: float, needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    inputs = (means, covars, quats, scales, opacities, colors, viewmats, centers)
    wanted = list(needs)
    if wanted[6] or wanted[7]:
        wanted[6] = True
    out = [means.new_empty(t.shape if w and t is not None else (0,)) for t, w in zip(inputs, wanted, strict=True)]
    if wanted[6] and centers is None:
        out[7] = means.new_empty((torch.Size(image_dims).numel(), 3))
    elif wanted[6] and centers is not None:
        out[7] = centers.new_empty(centers.shape)
    return out
