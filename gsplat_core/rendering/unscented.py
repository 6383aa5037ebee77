"""Rendering through distorted lenses and rolling shutters: operations of the pipeline with the unscented transform.

`rasterization(with_ut=True)` projects Gaussians by the unscented transform, and `with_eval3d=True` blends them by their
response along each pixel's ray (3DGUT, Wu et al. 2025). Tile lists and, without `with_eval3d`, blending are the ordinary
operations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops.arguments import DenseProjection, require_shape
from gsplat_core.ops.unscented_projection import UnscentedTransformParameters, fully_fused_projection_with_ut
from gsplat_core.ops.world_blending import rasterize_to_pixels_eval3d
from gsplat_core.poses.se3 import RollingShutterType, Shutter
from gsplat_core.rendering.settings import Arguments, RenderSettings
from gsplat_core.scene.distortion import FThetaCameraDistortionParameters

if TYPE_CHECKING:
    from gsplat_core.rendering.pipeline import Operations


class UnscentedCamera(NamedTuple):
    """Arguments of `rasterization` that are used only by the unscented transform and by blending along rays."""

    with_ut: bool
    with_eval3d: bool
    ut_params: UnscentedTransformParameters | None
    radial_coeffs: Tensor | None
    tangential_coeffs: Tensor | None
    thin_prism_coeffs: Tensor | None
    ftheta_coeffs: FThetaCameraDistortionParameters | None
    rolling_shutter: RollingShutterType | None
    viewmats_rs: Tensor | None

    @property
    def given(self) -> bool:
        """True if any argument was passed that differs from its default."""
        return any(
            value is not None and value is not False and getattr(value, "name", None) != "GLOBAL" for value in self
        )

    @property
    def lens(self) -> dict[str, Any]:
        """Lens and shutter, as keyword arguments of the operations."""
        return {
            name: value for name, value in self._asdict().items() if name not in ("with_ut", "with_eval3d", "ut_params")
        }


def with_unscented_camera(
    ops: Operations, camera: UnscentedCamera, arguments: Arguments, settings: RenderSettings
) -> tuple[Operations, Arguments, RenderSettings]:
    """Return operations, arguments and settings that render through the lens and shutter of `camera`.

    The view directions of spherical harmonics, and depths, are those at the middle of the read-out. Rows of `meta` are not
    packed.

    Raises:
        InvalidInput: for arguments that cannot be combined.
        NotImplementedError: for outputs that need straight rays from one position.
    """
    means, quats, scales = arguments.means, arguments.quats, arguments.scales
    if quats is None or scales is None or arguments.covars is not None:
        raise InvalidInput("with_ut and with_eval3d need quats and scales; covars are not supported")
    if settings.sparse_grad:
        raise InvalidInput("with_ut and with_eval3d have dense gradients; leave sparse_grad out")
    special = [
        name for name, value in camera.lens.items() if value is not None and getattr(value, "name", "") != "GLOBAL"
    ]
    if settings.camera_model == "ftheta":
        special.append("camera_model='ftheta'")
    if special and not camera.with_ut:
        raise InvalidInput(f"{', '.join(special)} need with_ut=True")
    # Both are blended by the ellipses of the splats in an undistorted picture.
    other_rays = [*special, *(["with_eval3d"] if camera.with_eval3d else [])]
    if other_rays and (settings.has_distance or settings.normals):
        raise NotImplementedError(
            f"distance along the rays and normals are not supported with {', '.join(other_rays)}; use the render modes D and ED"
            + (", or undistort the pictures" if special else ", or leave with_eval3d out")
        )
    if arguments.viewmats.dim() < 3 or means.dim() < 2:
        raise InvalidInput(f"viewmats must be [..., C, 4, 4], got {list(arguments.viewmats.shape)}")
    images = (*means.shape[:-2], arguments.viewmats.shape[-3])
    require_shape("viewmats", arguments.viewmats, (*images, 4, 4), "[..., C, 4, 4]")
    viewmats = arguments.viewmats
    options = camera.lens | {"camera_model": settings.camera_model}
    shutter = Shutter.of(viewmats, camera.viewmats_rs, camera.rolling_shutter)

    def project(
        means: Tensor, _covars: None, quats: Tensor, scales: Tensor, _middle: Tensor, Ks: Tensor, width: int, height: int,
        *, opacities: Tensor | None = None, packed: bool = False, sparse_grad: bool = False,
        camera_model: str = "", **limits: Any,
    ) -> DenseProjection:  # fmt: skip
        return fully_fused_projection_with_ut(
            means,
            quats,
            scales,
            opacities,
            viewmats,
            Ks,
            width,
            height,
            ut_params=camera.ut_params,
            **options,
            **limits,
        )

    def blend(
        _means2d: Tensor, _conics: Tensor, channels: Tensor, opacities: Tensor, width: int, height: int, tile_size: int,
        isect_offsets: Tensor, flatten_ids: Tensor, *, backgrounds: Tensor | None = None, packed: bool = False,
        absgrad: bool = False, max_alpha: float,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        return rasterize_to_pixels_eval3d(
            means, quats, scales, channels, opacities, viewmats, arguments.Ks, width, height, tile_size, isect_offsets,
            flatten_ids, backgrounds=backgrounds, max_alpha=max_alpha, **options,
        )  # fmt: skip

    def bin_by_boxes(
        *arguments: Any, conics: Tensor, opacities: Tensor, **options: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        # Evaluated along rays, a splat is no ellipse in the picture, so only the bounding boxes of the splats limit
        # their tiles.
        return ops.bin_splats(*arguments, **options)

    changes: dict[str, Any] = {"single_call": None}
    if camera.with_ut:
        changes["fully_fused_projection"] = project
    if camera.with_eval3d:
        changes |= {"rasterize_to_pixels": blend, "bin_splats": bin_by_boxes}
    return (
        replace(ops, **changes),
        arguments._replace(viewmats=shutter.matrices()),
        replace(settings, packed=False),
    )
