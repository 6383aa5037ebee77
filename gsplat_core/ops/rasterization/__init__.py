"""`rasterization()` on CUDA in one native call per pass: project, colour, sort and blend.

Follows Kerbl et al. 2023. Two autograd nodes expose the intermediate `means2d`: `_Project` (Gaussians to splats) and
`_Blend` (splats to the picture). `_Project` makes the single forward call of both.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from gsplat_core.ops.native import differentiable_once
from gsplat_core.rendering.settings import TILE_SIZE

PLAIN_COLORS = -1
"""Value of `Options.degree` for plain colours without spherical harmonics, at most `MOST_PLAIN_COLORS` channels."""
MOST_PLAIN_COLORS = 3
NO_DEPTH, DEPTH_SUM, EXPECTED_DEPTH = range(3)
MOST_PIXELS = 16 << 13
"""Largest width and height of a picture."""

_FORWARD = torch.ops.gsplat_core.rasterize.default
_SPLATS_BACKWARD = torch.ops.gsplat_core.rasterize_splats_backward.default
_INPUTS_BACKWARD = torch.ops.gsplat_core.rasterize_inputs_backward.default


class Options(NamedTuple):
    """Integer options of a rendering, in the argument order of the native op."""

    width: int
    height: int
    camera_model: int
    """Index of the camera model in CAMERA_MODELS."""
    degree: int
    """Degree of the spherical harmonics, 0 to 4; PLAIN_COLORS for colours without harmonics."""
    channels: int
    """Number of colour channels, 0 to 3."""
    depth_mode: int
    antialiased: int
    """1 to scale opacities by the antialiasing compensation, otherwise 0. The next two fields are flags, too."""
    packed: int
    absgrad: int
    capacity: int = 0
    """Expected length of the tile lists, or 0 if unknown. The result does not depend on it. If the lists are longer, the
    picture is rendered twice. If it is 0, the GPU waits for the host before it fills the lists.
    """


class Ranges(NamedTuple):
    """Floating-point options of a rendering, in the argument order of the native op.

    They are the blur in pixels², clipping planes in the scene's unit, and smallest radius in pixels.
    """

    eps2d: float
    near_plane: float
    far_plane: float
    radius_clip: float


class View(NamedTuple):
    """Arguments of a rendering that are not tensors: batch dimensions, picture size, options and ranges."""

    image_dims: tuple[int, ...]
    """Batch dimensions and number of cameras."""
    options: Options
    ranges: Ranges


class Inputs(NamedTuple):
    """Tensor arguments, float32 on one CUDA device; batch dimensions as in `rasterization()`."""

    means: Tensor
    covars: Tensor | None
    """Upper triangles of the covariances [..., N, 6]; None if quaternions and scales are given."""
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor | None
    """SH coefficients [..., (C,) N, K, 3] or plain colours [..., (C,) N, D]; None to render without colour."""
    viewmats: Tensor
    Ks: Tensor
    centers: Tensor | None
    """Camera centres [..., C, 3] if their gradient is needed; otherwise computed from the matrices."""
    backgrounds: Tensor | None
    """Background colours [..., C, channels]; None for black."""


class Saved(NamedTuple):
    """Values of the forward pass saved for the backward pass."""

    records: Tensor
    """Splats in the kernels' format, [images * N, 12]."""
    conics: Tensor
    isect_offsets: Tensor
    splat_ids: Tensor
    """Tile lists, int32 [M]; a splat's id is image * N + Gaussian."""
    sorted: Tensor
    """Index of each list entry among the (splat, tile) pairs in splat order, int32 [M]."""
    splat_starts: Tensor
    """Index of each splat's first (splat, tile) pair in splat order, int32 [images * N + 1]."""
    row_of: Tensor | None
    """Row of each splat in the packed results, or -1 for culled splats, int32 [images * N]; None unless packed."""
    backgrounds: Tensor | None
    alphas: Tensor
    expected: Tensor
    """Expected depth [..., C, H, W]; empty unless the picture has a depth channel that is divided by alpha."""
    last: Tensor
    """Index of the last tile-list entry that is blended in each pixel, or -1 for none, int32 [..., C, H, W]."""


class Rasterized(NamedTuple):
    """Rendered pictures and intermediate results of the forward pass.

    `opacities` is empty unless antialiased or packed. The ids are None unless packed.
    """

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
    """State of one forward pass, shared by the autograd functions of its two parts: inputs to splats, and splats to the
    image.
    """

    __slots__ = ("outputs", "view")

    def __init__(self, view: View) -> None:
        self.view = view
        self.outputs: list[Tensor] = []

    def left_for_gradients(self) -> list[Tensor]:
        """Tensors saved for the backward pass, in the op's argument order.

        These are records, splat_starts, sorted, last and expected. If packed, also row_of, the
        radii of all splats and splat_ids.
        """
        return self.outputs[14 if self.view.options.packed else 11 :]


def rasterize(inputs: Inputs, view: View, differentiable: bool) -> Rasterized:
    """Render; the caller has checked shapes, dtypes and devices.

    The host waits once, for the length of the tile lists. Equal inputs give bit-identical
    results, forward and backward.
    """
    returned = 14 if view.options.packed else 11
    if not differentiable:
        return Rasterized(*_FORWARD(inputs, *view, False)[:returned])
    call = _Call(view)
    means2d, depths, conics, opacities, records = _Project.apply(call, *inputs)
    image, alphas = _Blend.apply(call, means2d, records, inputs.backgrounds)
    return Rasterized(image, alphas, means2d, depths, conics, opacities, *call.outputs[6:returned])


class _Project(Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, *inputs: Any) -> tuple[Tensor, ...]:
        call.outputs = out = _FORWARD(inputs, *call.view, True)
        ctx.view = call.view
        ctx.set_materialize_grads(False)
        own = call.left_for_gradients()
        row_of, radii = (own[5], own[6]) if call.view.options.packed else (None, out[6])
        ctx.save_for_backward(*inputs, radii, row_of)
        return out[2], out[3], out[4], out[5], own[0]

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, *v: Tensor | None) -> tuple[Tensor | None, ...]:
        v_means2d, v_depths, v_conics, v_opacities, v_records = v
        *inputs, radii, row_of = ctx.saved_tensors
        wanted = list(ctx.needs_input_grad[1:])
        wanted[-1] = False  # the other autograd node returns the background's gradient
        if v_opacities is not None and not v_opacities.numel():
            v_opacities = None
        gradients = [v_records, v_means2d, v_depths, v_conics, v_opacities]
        out = _INPUTS_BACKWARD(inputs, radii, row_of, gradients, *ctx.view, wanted)
        return None, *(gradient if want else None for gradient, want in zip(out, wanted, strict=True))


class _Blend(Function):
    @staticmethod
    def forward(
        ctx: Any, call: _Call, means2d: Tensor, records: Tensor, backgrounds: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        out, own, options = call.outputs, call.left_for_gradients(), call.view.options
        ctx.view = call.view
        ctx.set_materialize_grads(False)
        row_of, splat_ids = (own[5], own[7]) if options.packed else (None, out[9])
        saved = Saved(
            records, conics=out[4], isect_offsets=out[8], splat_ids=splat_ids, sorted=own[2], splat_starts=own[1],
            row_of=row_of, backgrounds=backgrounds, alphas=out[1], expected=own[4], last=own[3],
        )  # fmt: skip
        ctx.save_for_backward(*saved, means2d if options.absgrad else None)
        return out[0], out[1]

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None) -> tuple[Tensor | None, ...]:
        *tensors, means2d = ctx.saved_tensors
        saved = Saved(*tensors)
        _, needs_means2d, needs_records, needs_backgrounds = ctx.needs_input_grad
        v_means2d = v_records = v_backgrounds = None
        if needs_backgrounds and v_image is not None:
            colors = v_image[..., : ctx.view.options.channels]
            v_backgrounds = (colors * (1 - saved.alphas)).sum((-3, -2))
        if needs_means2d or needs_records:
            v_records, v_means2d, absolute = _SPLATS_BACKWARD(saved, v_image, v_alphas, *ctx.view)
            if means2d is not None:
                means2d.absgrad = absolute
        return None, v_means2d, v_records, v_backgrounds


@torch.library.register_fake("gsplat_core::rasterize")
def _fake(
    inputs: list[Tensor | None], image_dims: list[int], options: list[int], ranges: list[float], training: bool
) -> list[Tensor]:
    means, option = inputs[0], Options(*options)
    assert means is not None
    n, size = means.shape[-2], torch.library.get_ctx().new_dynamic_size
    images, length = torch.Size(image_dims).numel(), size()
    floats = lambda *shape: means.new_empty(shape)
    ints = lambda *shape: means.new_empty(shape, dtype=torch.int32)
    longs = lambda *shape: means.new_empty(shape, dtype=torch.int64)
    pixels = (*image_dims, option.height, option.width)
    rows = (size(),) if option.packed else (*image_dims, n)
    own_opacities = option.packed or option.antialiased
    tiles = (-(-option.height // TILE_SIZE), -(-option.width // TILE_SIZE))
    out = [
        floats(*pixels, option.channels + (option.depth_mode != NO_DEPTH)), floats(*pixels, 1), floats(*rows, 2),
        floats(*rows), floats(*rows, 3), floats(*rows) if own_opacities else floats(0), ints(*rows, 2), ints(*rows),
        ints(*image_dims, *tiles), ints(length), longs(length),
    ]  # fmt: skip
    if option.packed:
        out += [longs(*rows) for _ in range(3)]
    if training:
        expected = floats(*pixels) if option.depth_mode == EXPECTED_DEPTH else floats(0)
        out += [floats(images * n, 12), ints(images * n + 1), ints(length), ints(*pixels), expected]
    if training and option.packed:
        out += [ints(images * n), ints(*image_dims, n, 2), ints(length)]
    return out


@torch.library.register_fake("gsplat_core::rasterize_splats_backward")
def _fake_splats_backward(
    saved: list[Tensor | None], v_image: Tensor | None, v_alphas: Tensor | None, image_dims: list[int],
    options: list[int], ranges: list[float],
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    records, conics = saved[:2]
    assert records is not None and conics is not None
    rows = (*conics.shape[:-1], 2)
    absolute = rows if Options(*options).absgrad else (0,)
    return records.new_empty(records.shape), conics.new_empty(rows), conics.new_empty(absolute)


@torch.library.register_fake("gsplat_core::rasterize_inputs_backward")
def _fake_inputs_backward(
    inputs: list[Tensor | None], radii: Tensor, row_of: Tensor | None, gradients: list[Tensor | None],
    image_dims: list[int], options: list[int], ranges: list[float], needs: list[bool],
) -> list[Tensor]:  # fmt: skip
    wanted = dict(zip(Inputs._fields, needs, strict=True))
    views = wanted["viewmats"] or wanted["centers"]
    wanted |= {"viewmats": views, "centers": views, "Ks": False, "backgrounds": False}
    empty = lambda t, want: radii.new_empty(t.shape if want and t is not None else (0,), dtype=torch.float32)
    return [empty(t, want) for t, want in zip(inputs, wanted.values(), strict=True)]
