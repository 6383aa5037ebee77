"""Operations in plain torch, for any floating dtype and device, differentiable by autograd: the deformation fields, and
the separate steps of a projection.

The fields use them where no kernels exist, and `HexPlaneField` trains with them on the CPU. They are also the reference
for tests of the kernels. This module does not load the compiled core.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import FOV_MARGIN, require_same_kind, require_shape, require_trailing
from gsplat_core.ops.modes import without_autocast
from gsplat_core.scene.gaussians import COLOUR, LOG_SCALE, OPACITY, POSITION, RAW_COLUMNS, ROTATION, width_of

BASIS_GROUPS = (POSITION, ROTATION, LOG_SCALE, COLOUR)
"""Columns, by parameter, of the raw parameters [N, 16] that a basis field changes: the first `BASIS_CHANNELS` ones."""
BASIS_CHANNELS = width_of(*BASIS_GROUPS)
BUMP_REACH = 4.0
"""Truncation radius of a bump in widths; its height there is exp(-16) = 1e-7."""
LEAST_SQUARED_HEIGHTS = 1e-2
"""Sum of a Gaussian's squared bump heights at a time, below which its deltas at that time are not changed, because the change
of weights would be huge.
"""


def basis_field(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, padded: bool = False
) -> Tensor:
    """Evaluate truncated bumps in time: delta[n] = sum_b exp(-u²) weights[n, b] for |u| <= 4.

    u = (tau - center) / width. Based on the basis functions of Deform3DGS (Yang et al. 2024, eq. 5), with timing shared
    by all channels. NaN in a centre or width propagates to the Gaussian's deltas.

    Args:
        centers: [N, B].
        log_widths: [N, B].
        weights: [N, B, C].
        tau: time in the units of the centres.
        padded: append zero columns up to `RAW_COLUMNS`.

    Returns:
        Deltas [N, C], or [N, 16] if padded.
    """
    u = (tau - centers) * torch.exp(-log_widths)
    inactive = u.abs() > BUMP_REACH
    bumps = torch.exp(-(u.masked_fill(inactive, 0.0) ** 2)).masked_fill(inactive, 0.0)
    # Mask the weights, so that those of inactive bumps have no effect, even if NaN.
    deltas = (bumps[..., None] * weights.masked_fill(inactive[..., None], 0.0)).sum(dim=1)
    return torch.nn.functional.pad(deltas, (0, RAW_COLUMNS - deltas.shape[1])) if padded else deltas


def basis_field_backward(
    gradient: Tensor, centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of (centers, log_widths, weights); exactly zero for inactive bumps.

    Args:
        gradient: dL/d(deltas) [N, C]; further columns are ignored.
    """
    gradient = gradient[:, : weights.shape[2]]
    inverse_width = torch.exp(-log_widths)
    u = (tau - centers) * inverse_width
    inactive = u.abs() > BUMP_REACH
    u = u.masked_fill(inactive, 0.0)
    bumps = torch.exp(-(u**2)).masked_fill(inactive, 0.0)
    slope = bumps * 2.0 * u * torch.einsum("nc,nbc->nb", gradient, weights.masked_fill(inactive[..., None], 0.0))
    return slope * inverse_width.masked_fill(inactive, 0.0), slope * u, bumps[..., None] * gradient[:, None, :]


def basis_field_backward_adam_(
    gradient: Tensor,
    tau: float | Tensor,
    field: Sequence[Tensor],
    first_moments: Sequence[Tensor],
    second_moments: Sequence[Tensor],
    steps: Tensor,
    learning_rates: Sequence[float] | Tensor,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-8,
) -> None:
    """Take one lazy Adam step of every bump active at `tau`, in place.

    Inactive bumps and their moments are not changed. A Gaussian with a zero gradient in all channels is skipped,
    because it is not visible in the frame and momentum must not move it. A Gaussian whose squared gradient is not
    finite is skipped, because it would corrupt the moments permanently. The per-bump step counts give each bump Adam's
    bias correction (Kingma and Ba 2015, algorithm 1) from its own first update.

    Args:
        gradient: dL/d(deltas) [N, 13] or [N, 16].
        tau: normalised time.
        field: centers [N, B], log_widths [N, B], weights [N, B, 13].
        first_moments: tensors with the shapes of `field`.
        second_moments: tensors with the shapes of `field`.
        steps: int32 [N, B], number of updates of each bump.
        learning_rates: six rates: position, rotation, log-scale, colour, centres, widths.
        betas: decay rates of the moments.
        epsilon: term added to the denominator.
    """
    centers, log_widths, weights = field
    beta1, beta2 = betas
    with torch.no_grad():
        gradients = basis_field_backward(gradient, centers, log_widths, weights, tau)
        active = ~(((tau - centers) * torch.exp(-log_widths)).abs() > BUMP_REACH)
        gradient = gradient[:, : weights.shape[2]]
        active &= (gradient != 0).any(dim=1, keepdim=True) & gradient.square().isfinite().all(dim=1, keepdim=True)
        steps += active.to(steps.dtype)
        count = steps.clamp(min=1).to(centers.dtype)
        bias1, bias2 = 1 - beta1**count, 1 - beta2**count
        each = torch.as_tensor(learning_rates, dtype=centers.dtype, device=centers.device)
        channel_rates = each[:4].repeat_interleave(
            torch.tensor([width_of(group) for group in BASIS_GROUPS], device=centers.device)
        )
        rates = (each[4], each[5], channel_rates)
        for parameter, g, m, v, rate in zip(field, gradients, first_moments, second_moments, rates, strict=True):
            shape = active.shape + (1,) * (g.dim() - 2)
            chosen = active.reshape(shape)
            m.copy_(torch.where(chosen, m + (1 - beta1) * (g - m), m))
            v.copy_(torch.where(chosen, v + (1 - beta2) * (g * g - v), v))
            step = rate * (m / bias1.reshape(shape)) / ((v / bias2.reshape(shape)).sqrt() + epsilon)
            parameter.copy_(torch.where(chosen, parameter - step, parameter))


def basis_field_move_to_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, target: Tensor
) -> None:
    """Change the weights minimally in place so that the deltas at `tau` become `target` [N, C].

    Let h_b = exp(-u_b^2) be the bump heights (see `basis_field`). The minimum-norm weight change is h_b / sum(h^2)
    times the change of the deltas. The deltas at d bump spacings from `tau` change by exp(-d^2 / 2) of it, as by
    training on that frame alone. Rows with a non-finite change, or without a bump near `tau` (`LEAST_SQUARED_HEIGHTS`),
    are skipped.
    """
    with torch.no_grad():
        change = target - basis_field(centers, log_widths, weights, tau)
        u = (tau - centers) * torch.exp(-log_widths)
        heights = torch.where(u.abs() > BUMP_REACH, torch.zeros_like(u), torch.exp(-u * u))
        squared = (heights * heights).sum(dim=1, keepdim=True)
        usable = (squared > LEAST_SQUARED_HEIGHTS) & change.isfinite().all(dim=1, keepdim=True)
        share = torch.where(usable, heights / squared.clamp(min=LEAST_SQUARED_HEIGHTS), torch.zeros_like(heights))
        weights += share[..., None] * torch.where(usable, change, torch.zeros_like(change))[:, None]


def basis_field_add_colours_(
    centers: Tensor, log_widths: Tensor, weights: Tensor, tau: float | Tensor, change: Tensor
) -> None:
    """Change `weights` in place so that the colours at `tau` change by `change` [N, 3].

    Let h_b = exp(-u_b^2) be the bump heights (see `basis_field`). The minimum-norm weight change is
    h_b / sum(h^2) times `change`. The colours at d bump spacings from `tau` change by exp(-d^2 / 2)
    of it. Gaussians with a non-finite change, or without a significant bump height, are skipped.
    """
    u = (tau - centers) * torch.exp(-log_widths)
    heights = torch.where(u.abs() > BUMP_REACH, torch.zeros_like(u), torch.exp(-u * u))
    squared = heights.square().sum(dim=1, keepdim=True)
    usable = (squared > LEAST_SQUARED_HEIGHTS) & change.square().sum(dim=1, keepdim=True).isfinite()
    share = torch.where(usable, heights / squared, torch.zeros_like(heights))
    weights[..., COLOUR] += share[..., None] * torch.where(usable, change, torch.zeros_like(change))[:, None]


HEAD_GROUPS = (POSITION, LOG_SCALE, ROTATION, OPACITY)
"""Parameters in the output order of the HexPlane network, with log-scales before rotation as in G-SHARP."""
HEAD_COLUMNS = tuple(column for group in HEAD_GROUPS for column in range(group.start, group.stop))
"""Column of the raw parameters [N, 16] to which each output of the HexPlane network is added."""


def sample_plane(plane: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Sample `plane` [V, U, C] bilinearly at `u`, `v` in [-1, 1]; returns [N, C].

    Corners are aligned, and coordinates are clamped at the border.
    """
    grid = torch.stack([u, v], dim=-1)[None, None]
    image = plane.permute(2, 0, 1)[None]
    sampled = torch.nn.functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)
    return sampled[0, :, 0].T


PLANE_AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes (u, v) of the planes xy, xz, yz, xt, yt, zt.

A plane is stored as [size of v, size of u, channels].
"""


def hexplane_features(
    coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor, xt: Tensor, yt: Tensor, zt: Tensor
) -> Tensor:
    """Return the product of six bilinear plane samples of one level (Cao & Johnson 2023, eq. 3).

    Args:
        coordinates: x, y, z, t in [-1, 1], [N, 4].
        xy: plane [V, U, C], as the other five planes, with the axes of PLANE_AXES.

    Returns:
        Features [N, C].
    """
    product = None
    for plane, (a, b) in zip((xy, xz, yz, xt, yt, zt), PLANE_AXES, strict=True):
        value = sample_plane(plane, coordinates[:, a], coordinates[:, b])
        product = value if product is None else product * value
    assert product is not None
    return product


def hexplane_space(coordinates: Tensor, xy: Tensor, xz: Tensor, yz: Tensor) -> Tensor:
    """Return the time-independent part of `hexplane_features`: the product [N, C] of space planes."""
    x, y, z = coordinates[:, 0], coordinates[:, 1], coordinates[:, 2]
    return sample_plane(xy, x, y) * sample_plane(xz, x, z) * sample_plane(yz, y, z)


def hexplane_modulate(space: Tensor, coordinates: Tensor, xt: Tensor, yt: Tensor, zt: Tensor) -> Tensor:
    """Multiply `space` [N, C] by samples of three lines [U, C].

    The lines are the time planes interpolated at one time.
    """
    product = space
    for axis, line in enumerate((xt, yt, zt)):
        u = coordinates[:, axis]
        product = product * sample_plane(line[None], u, torch.zeros_like(u))
    return product


def hexplane_decode(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    lines: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> Tensor:
    """Decode features with an MLP with ReLU between its layers.

    Args:
        spaces: products of the space planes [N, C] of each level; levels are concatenated.
        coordinates: positions and time in [-1, 1], [N, 4].
        lines: three time lines [U, C] per level, multiplied with `spaces`; may be empty.
        weights: weight matrices [outputs, inputs] of the layers, as in `torch.nn.Linear`.
        biases: biases of the layers.

    Returns:
        [N, outputs].
    """
    levels = list(spaces)
    if lines:
        levels = [
            hexplane_modulate(space, coordinates, *lines[3 * level : 3 * level + 3])
            for level, space in enumerate(levels)
        ]
    values = torch.cat(levels, dim=1)
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        values = torch.nn.functional.linear(torch.relu(values) if layer else values, weight, bias)
    return values


def hexplane_deltas(
    spaces: Sequence[Tensor],
    coordinates: Tensor,
    time: Tensor,
    time_planes: Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    order: Tensor | None = None,
    decode: Callable[..., Tensor] | None = None,
) -> Tensor:
    """Return the field's deltas of the raw parameters at `time`.

    The time planes are interpolated to lines at `time`, which `hexplane_decode` (or `decode`)
    combines with the space features.

    Args:
        spaces: per level the product of the space planes, [N, C].
        coordinates: positions in [-1, 1], [N, 4].
        time: normalised time in [-1, 1], one element.
        time_planes: xt, yt, zt of every level, [V, U, C].
        weights: weight matrices of the trunk's layers and the head.
        biases: biases of the same layers.
        order: row i of the inputs belongs to Gaussian order[i]; None for the identity.
        decode: replacement for `hexplane_decode`.

    Returns:
        Deltas [N, 16] in the layout of `scene.gaussians`.
    """
    # No host synchronisation or copy, so that a CUDA graph can capture the call.
    lines = []
    for plane in time_planes:
        at = ((time.reshape(1) + 1) / 2 * (plane.shape[0] - 1)).clamp(0, plane.shape[0] - 1)
        row = at.detach().nan_to_num().long().clamp(max=max(plane.shape[0] - 2, 0))
        next_row = (row + 1).clamp(max=plane.shape[0] - 1)
        lines.append(torch.lerp(plane.index_select(0, row)[0], plane.index_select(0, next_row)[0], at - row))
    outputs = (decode or hexplane_decode)(spaces, coordinates, lines, weights, biases)
    position, log_scale, rotation, opacity = outputs.split([width_of(group) for group in HEAD_GROUPS], dim=1)
    n, no_colour = len(outputs), width_of(COLOUR)
    deltas = torch.cat(
        [
            position,
            rotation,
            log_scale,
            outputs.new_zeros(n, no_colour),
            opacity,
            outputs.new_zeros(n, RAW_COLUMNS - OPACITY.stop),
        ],
        dim=1,
    )
    return deltas if order is None else torch.zeros_like(deltas).index_copy(0, order.long(), deltas)


FISHEYE_SERIES_BELOW = 0.01
"""Bound of tan θ below which the fisheye's quotients by r use their Taylor series."""


def _pinhole(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Project with the pinhole model.

    Returns image points [..., C, N, 2] and Jacobians [..., C, N, 2, 3] of camera-space points [..., C, N, 3].
    """
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margin_x, margin_y = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    # The linearisation diverges far off axis, so it is evaluated at the border of a slightly larger view.
    slope_x = torch.minimum(torch.maximum(x / z, -(cx / fx + margin_x)), (width - cx) / fx + margin_x)
    slope_y = torch.minimum(torch.maximum(y / z, -(cy / fy + margin_y)), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(x)
    jacobian = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    return means2d, jacobian.unflatten(-1, (2, 3))


def _ortho(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    x, y, _ = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    zero = torch.zeros_like(x)
    jacobian = torch.stack([fx.expand_as(x), zero, zero, zero, fy.expand_as(x), zero], -1)
    return torch.stack([fx * x + cx, fy * y + cy], -1), jacobian.unflatten(-1, (2, 3))


def _fisheye(p: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Project with the equidistant fisheye model, in which the image radius is f θ.

    With s = θ/r and q = (dθ/dr - s)/r², du/dx = fx (s + q x²). Results have the shapes of `_pinhole`.
    """
    x, y, z = p.unbind(-1)
    fx, fy, cx, cy = (Ks[..., row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    near_axis = (x * x + y * y < (FISHEYE_SERIES_BELOW * z) ** 2) & (z > 0)
    r2 = torch.where(near_axis, torch.ones_like(x), x * x + y * y)
    r = r2.sqrt()
    squared = r2 + z * z
    s_far = torch.atan2(r, z) / r
    q_far = (z / squared - s_far) / r2
    z_near = torch.where(near_axis, z, torch.ones_like(z))
    t2 = torch.where(near_axis, (x * x + y * y) / (z_near * z_near), torch.zeros_like(x))
    s_near = (1 - t2 / 3 + t2**2 / 5 - t2**3 / 7) / z_near
    q_near = (-2 / 3 + 4 / 5 * t2 - 6 / 7 * t2**2 + 8 / 9 * t2**3) / z_near**3
    s, q = torch.where(near_axis, s_near, s_far), torch.where(near_axis, q_near, q_far)
    inverse = 1 / (x * x + y * y + z * z)
    jacobian = torch.stack(
        [
            fx * (s + q * x * x),
            fx * q * x * y,
            -fx * x * inverse,
            fy * q * x * y,
            fy * (s + q * y * y),
            -fy * y * inverse,
        ],
        -1,
    )
    return torch.stack([fx * x * s + cx, fy * y * s + cy], -1), jacobian.unflatten(-1, (2, 3))


PROJECTIONS = {"pinhole": _pinhole, "ortho": _ortho, "fisheye": _fisheye}
"""Image points and Jacobians of each camera model."""


@without_autocast
def proj(
    means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int, camera_model: str = "pinhole"
) -> tuple[Tensor, Tensor]:
    """Project Gaussians in camera axes to the picture by EWA splatting (Zwicker et al. 2001), without blur and culling.

    Args:
        means: centres [..., C, N, 3].
        covars: covariances [..., C, N, 3, 3].
        Ks: intrinsic matrices [..., C, 3, 3].
        width: width of the picture in pixels. Only pinhole cameras use the size, for the limit of the linearisation.
        height: height of the picture in pixels.
        camera_model: "pinhole", "ortho" or "fisheye".

    Returns:
        Centres [..., C, N, 2] in pixels, and covariances [..., C, N, 2, 2] in pixels².

    Raises:
        InvalidInput: for wrong shapes or an unknown camera model.
    """
    leading = require_trailing("means", means, (3,), "[..., C, N, 3]")
    if len(leading) < 2:
        raise InvalidInput(f"means must be [..., C, N, 3], got {list(means.shape)}")
    require_shape("covars", covars, (*leading, 3, 3), "[..., C, N, 3, 3]")
    require_shape("Ks", Ks, (*leading[:-1], 3, 3), "[..., C, 3, 3]")
    require_same_kind(means=means, covars=covars, Ks=Ks)
    if camera_model not in PROJECTIONS:
        raise InvalidInput(f"proj has no camera model {camera_model!r}; the models are {', '.join(PROJECTIONS)}")
    means2d, jacobian = PROJECTIONS[camera_model](means, Ks, width, height)
    return means2d, jacobian @ covars @ jacobian.mT


@without_autocast
def world_to_cam(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres [..., C, N, 3] and covariances [..., C, N, 3, 3] in the axes of each camera.

    Args:
        means: centres [..., N, 3] in world axes.
        covars: covariances [..., N, 3, 3].
        viewmats: world-to-camera matrices [..., C, 4, 4].

    Raises:
        InvalidInput: for wrong shapes.
    """
    leading = require_trailing("means", means, (3,), "[..., N, 3]")
    require_shape("covars", covars, (*leading, 3, 3), "[..., N, 3, 3]")
    cameras = require_trailing("viewmats", viewmats, (4, 4), "[..., C, 4, 4]")
    if not leading or not cameras or cameras[:-1] != leading[:-1]:
        raise InvalidInput(
            f"viewmats must be [..., C, 4, 4] with ... = {list(leading[:-1])}, got {list(viewmats.shape)}"
        )
    require_same_kind(means=means, covars=covars, viewmats=viewmats)
    rotation = viewmats[..., None, :3, :3]
    turned = (rotation @ means[..., None, :, :, None])[..., 0] + viewmats[..., None, :3, 3]
    return turned, rotation @ covars[..., None, :, :, :] @ rotation.mT
