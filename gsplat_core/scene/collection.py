"""Editable collection of Gaussians: selection by place or label, rigid and uniform changes, colour, deletion and merging.

Spherical harmonics are evaluated and rotated at any floating dtype; the order of coefficients is that of `Gaussians.sh`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.scene.gaussians import SH_C0, Gaussians, require_gaussians


def harmonic_bases(degree: int, dirs: Tensor) -> Tensor:
    """Evaluate the basis functions of degrees 0 to `degree` in unit directions (Sloan 2013).

    A basis function of degree l and order m is a polynomial in z times the real (m >= 0) or imaginary part of
    (x + iy)^|m|. The polynomials are associated Legendre functions by their recursion, with the phase (-1)^m.

    Args:
        degree: highest degree.
        dirs: unit vectors [..., 3].

    Returns:
        Values [..., (degree + 1)²], by degree, then by order from -l to l.
    """
    x, y, z = dirs.unbind(-1)
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        a, b = real[-1], imaginary[-1]
        real.append(x * a - y * b)
        imaginary.append(x * b + y * a)
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(z, (-1) ** m * math.prod(range(1, 2 * m, 2)))
        for l in range(m + 1, degree + 1):
            before = legendre[l - 2, m] * (l + m - 1) if l > m + 1 else 0.0
            legendre[l, m] = ((2 * l - 1) * z * legendre[l - 1, m] - before) / (l - m)
    bases = []
    for l in range(degree + 1):
        for order in range(-l, l + 1):
            m = abs(order)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            part = imaginary[m] if order < 0 else real[m]
            bases.append(norm * (math.sqrt(2) if m else 1) * legendre[l, m] * part)
    return torch.stack(bases, -1)


def rotated_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Return the coefficients of a function on the sphere after the rotation of the sphere.

    The matrix of each degree follows from the basis functions in some directions and in the same directions rotated
    back, by least squares in float64.

    Args:
        sh: coefficients [N, K, 3], K = (degree + 1)².
        rotation: rotation matrix [3, 3].

    Returns:
        Coefficients [N, K, 3], whose values in direction d are those of `sh` in the direction `rotation.T @ d`.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    generator = torch.Generator().manual_seed(0)
    dirs = torch.randn(8 * (2 * degree + 1), 3, generator=generator, dtype=torch.float64)
    dirs = torch.nn.functional.normalize(dirs, dim=-1)
    turned = rotation.detach().to("cpu", torch.float64)
    after, before = harmonic_bases(degree, dirs), harmonic_bases(degree, dirs @ turned)
    bands = [sh[:, :1]]
    for l in range(1, degree + 1):
        band = slice(l * l, (l + 1) ** 2)
        matrix = torch.linalg.lstsq(after[:, band], before[:, band]).solution.to(sh.device, sh.dtype)
        bands.append(torch.einsum("ij,njc->nic", matrix, sh[:, band]))
    return torch.cat(bands, 1)


LABELS = "semantics"
"""Name of the extra tensor [N, classes] whose largest logit is the label."""
LEAST_SCALE = 1e-37
"""Smallest factor of `GaussianCollection.transform`, and the inverse of the largest."""
MOST_ROTATION_ERROR = 1e-4
"""Largest element of `rotation @ rotation.T` minus the identity for a matrix that is accepted as a rotation."""

Point = Sequence[float] | Tensor


class GaussianCollection:
    """Gaussians that are edited in place.

    A selection is a bool mask [N] of the present Gaussians. `in_box`, `in_sphere` and `labelled` create one; `&`, `|`
    and `~` combine them. Edits without a selection concern all Gaussians. `delete` and `merge` change N, so selections
    made before do not fit any more and are refused. Tensors given to the constructor are never changed.

        scene = GaussianCollection(load_ply("scene.ply"))
        scene.delete(~scene.in_sphere((0, 0, 60), 25))
        scene.transform(scale=0.1)
        save_gaussians(scene.gaussians, "cut.splat")
    """

    def __init__(self, gaussians: Gaussians) -> None:
        require_gaussians("GaussianCollection", gaussians)
        self._gaussians = gaussians.detach()

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians in their present state."""
        return self._gaussians

    def __len__(self) -> int:
        return self._gaussians.count

    def everything(self) -> Tensor:
        """Return the selection of all Gaussians."""
        return torch.ones(len(self), dtype=torch.bool, device=self._gaussians.device)

    def in_box(self, low: Point, high: Point) -> Tensor:
        """Return the selection of Gaussians with centres in a box along the axes.

        Args:
            low: corner with the smallest x, y and z, world units; included.
            high: corner with the largest x, y and z; included.

        Raises:
            InvalidInput: if a corner is not three numbers, or the box is empty.
        """
        lowest, highest = self._point("low", low), self._point("high", high)
        if bool((lowest > highest).any()):
            raise InvalidInput(
                f"box from {lowest.tolist()} to {highest.tolist()} is empty; give the smaller corner first"
            )
        means = self._gaussians.means
        return ((means >= lowest) & (means <= highest)).all(-1)

    def in_sphere(self, center: Point, radius: float) -> Tensor:
        """Return the selection of Gaussians with centres at most `radius` from `center`, world units.

        Raises:
            InvalidInput: if the centre is not three numbers, or the radius is negative.
        """
        if not radius >= 0:
            raise InvalidInput(f"radius must be 0 or more, got {radius}")
        return (self._gaussians.means - self._point("center", center)).norm(dim=-1) <= radius

    def labelled(self, label: int) -> Tensor:
        """Return the selection of Gaussians whose most likely class is `label`.

        Classes are the columns of the extra tensor `semantics`, which training with the loss `semantics` adds.

        Raises:
            InvalidInput: if the Gaussians have no labels, or not this one.
        """
        logits = self._gaussians.extra.get(LABELS)
        if logits is None or logits.dim() != 2:
            raise InvalidInput(f"the Gaussians have no labels (extra tensor {LABELS!r}); train with --losses {LABELS}")
        if not 0 <= label < logits.shape[1]:
            raise InvalidInput(f"label must be from 0 to {logits.shape[1] - 1}, got {label}")
        return logits.argmax(-1) == label

    def transform(
        self,
        selection: Tensor | None = None,
        *,
        rotation: Tensor | Sequence[Sequence[float]] | None = None,
        translation: Point | None = None,
        scale: float = 1.0,
    ) -> None:
        """Rotate and scale about the origin, then translate. View-dependent colours rotate, too.

        Args:
            selection: bool [N]; None for all.
            rotation: rotation matrix [3, 3].
            translation: shift in world units, [3].
            scale: factor of positions and sizes, 1e-37 to 1e37, the range of float32.

        Raises:
            InvalidInput: for a matrix that is no rotation, or a scale out of range.
        """
        if not LEAST_SCALE <= scale <= 1 / LEAST_SCALE:
            raise InvalidInput(f"scale must be from {LEAST_SCALE:g} to {1 / LEAST_SCALE:g}, got {scale}")
        rows = self._rows(selection)
        turned = self._gaussians.select(rows)
        means = turned.means
        if rotation is not None:
            matrix = self._rotation(rotation)
            means = means @ matrix.to(means).T
            right = None if turned.right_sh is None else rotated_harmonics(turned.right_sh, matrix)
            quats = _product(_quaternion(matrix).to(turned.quats), turned.quats)
            turned = replace(turned, quats=quats, sh=rotated_harmonics(turned.sh, matrix), right_sh=right)
        means = means * scale
        if translation is not None:
            means = means + self._point("translation", translation)
        self._replace(rows, replace(turned, means=means, log_scales=turned.log_scales + math.log(scale)))

    def recolour(self, selection: Tensor | None = None, *, colour: Point) -> None:
        """Give Gaussians one colour that is the same in every direction.

        Args:
            selection: bool [N]; None for all.
            colour: red, green and blue, 0 to 1.

        Raises:
            InvalidInput: if the colour is not three numbers from 0 to 1.
        """
        rgb = self._point("colour", colour)
        if bool(((rgb < 0) | (rgb > 1)).any()):
            raise InvalidInput(f"colour must be red, green and blue from 0 to 1, got {rgb.tolist()}")
        rows = self._rows(selection)
        painted = self._gaussians.select(rows)
        sh = torch.zeros_like(painted.sh)
        sh[:, 0] = (rgb - 0.5) / SH_C0
        right = None if painted.right_sh is None else torch.zeros_like(sh)
        self._replace(rows, replace(painted, sh=sh, right_sh=right))

    def delete(self, selection: Tensor) -> None:
        """Remove the selected Gaussians; the others keep their order."""
        self._gaussians = self._gaussians.select(~self._rows(selection))

    def merge(self, other: Gaussians | GaussianCollection) -> None:
        """Append other Gaussians. Optional tensors that either side lacks are zeros there.

        Of two degrees of spherical harmonics the higher one is kept; the other side's further coefficients are zeros.

        Raises:
            InvalidInput: if dtype, device or the shape of an extra tensor differ.
        """
        added = other.gaussians if isinstance(other, GaussianCollection) else other
        require_gaussians("merge", added)
        mine, theirs = self._gaussians, added.detach()
        bases = max(mine.sh.shape[1], theirs.sh.shape[1])
        mine, theirs = _with_bases(mine, bases), _with_bases(theirs, bases)
        if theirs.right_sh is not None:
            mine = mine.with_right()
        extra = {
            name: mine.extra.get(name, tensor.new_zeros(mine.count, *tensor.shape[1:]))
            for name, tensor in theirs.extra.items()
        }
        self._gaussians = replace(mine, extra={**mine.extra, **extra}).append(theirs)

    def _rows(self, selection: Tensor | None) -> Tensor:
        if selection is None:
            return self.everything()
        if selection.dtype != torch.bool or selection.shape != (len(self),):
            raise InvalidInput(
                f"a selection of this collection is bool [{len(self)}], got {selection.dtype} {list(selection.shape)};"
                " select again after delete or merge"
            )
        return selection.to(self._gaussians.device)

    def _replace(self, rows: Tensor, changed: Gaussians) -> None:
        tensors, new = self._gaussians.tensors(), changed.tensors()
        self._gaussians = Gaussians.from_tensors(
            {name: tensor.index_put((rows,), new[name]) for name, tensor in tensors.items()}
        )

    def _point(self, name: str, values: Point) -> Tensor:
        point = torch.as_tensor(values, dtype=self._gaussians.dtype, device=self._gaussians.device)
        if point.shape != (3,) or not bool(point.isfinite().all()):
            raise InvalidInput(f"{name} must be three finite numbers, got {point.tolist()}")
        return point

    @staticmethod
    def _rotation(rotation: Tensor | Sequence[Sequence[float]]) -> Tensor:
        matrix = torch.as_tensor(rotation, dtype=torch.float64).detach().cpu()
        if matrix.shape != (3, 3):
            raise InvalidInput(f"rotation must be [3, 3], got {list(matrix.shape)}")
        error = float((matrix @ matrix.T - torch.eye(3, dtype=torch.float64)).abs().max())
        if not error < MOST_ROTATION_ERROR or float(torch.linalg.det(matrix)) < 0:
            raise InvalidInput(
                f"rotation must be a rotation matrix without scale and reflection, got {matrix.tolist()}; give the factor as"
                " scale"
            )
        return matrix


def _with_bases(gaussians: Gaussians, bases: int) -> Gaussians:
    padding = (0, 0, 0, bases - gaussians.sh.shape[1])
    pad = torch.nn.functional.pad
    right = None if gaussians.right_sh is None else pad(gaussians.right_sh, padding)
    return replace(gaussians, sh=pad(gaussians.sh, padding), right_sh=right)


def _quaternion(matrix: Tensor) -> Tensor:
    """Return the unit quaternion wxyz [4] of a rotation matrix, from its largest component (Shepperd 1978)."""
    m = matrix
    # 4 w², 4 x², 4 y² and 4 z² of the quaternion
    squares = torch.stack([m.trace(), *(2 * m.diagonal() - m.trace())]) + 1
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = [
        torch.stack([squares[0], wx, wy, wz]),
        torch.stack([wx, squares[1], xy, xz]),
        torch.stack([wy, xy, squares[2], yz]),
        torch.stack([wz, xz, yz, squares[3]]),
    ]
    return torch.nn.functional.normalize(rows[int(squares.argmax())], dim=0)


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Return the quaternion product of one wxyz [4] with many [N, 4]."""
    w, vector = first[0], first[1:]
    real, others = second[:, :1], second[:, 1:]
    scalar = w * real - (others * vector).sum(-1, keepdim=True)
    return torch.cat([scalar, w * others + real * vector + torch.linalg.cross(vector.expand_as(others), others)], -1)
