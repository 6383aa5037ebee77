"""Splatting core: Gaussians, cameras, rasterization, deformation, losses, training and file formats.

Names are imported lazily. Importing the package alone loads neither torch nor the compiled library, so
`gsplat_core.reference` works without a built library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsplat_core.choices import RENDERERS
    from gsplat_core.deformation import DeformationField
    from gsplat_core.errors import CoreError, InvalidInput
    from gsplat_core.io.bundle import load_bundle, save_bundle
    from gsplat_core.io.exports.export import export_splats, save_gaussians
    from gsplat_core.io.ply import load_ply, save_ply
    from gsplat_core.io.png_compression import PngCompression
    from gsplat_core.io.recordings import open_recording
    from gsplat_core.models import Model, Snapshot, SnapshotSlots
    from gsplat_core.ops.compositing import accumulate, rasterize_to_indices_in_range, rasterize_to_pixels
    from gsplat_core.ops.covariance import quat_scale_to_covar_preci
    from gsplat_core.ops.plain_torch import proj, world_to_cam
    from gsplat_core.ops.projection import fully_fused_projection
    from gsplat_core.ops.spherical_harmonics import spherical_harmonics
    from gsplat_core.ops.ssim import fused_ssim
    from gsplat_core.ops.surfel_blending import (
        accumulate_2dgs,
        rasterize_to_indices_in_range_2dgs,
        rasterize_to_pixels_2dgs,
    )
    from gsplat_core.ops.surfel_projection import fully_fused_projection_2dgs
    from gsplat_core.ops.tiles import isect_offset_encode, isect_tiles
    from gsplat_core.ops.unscented_projection import UnscentedTransformParameters, fully_fused_projection_with_ut
    from gsplat_core.ops.world_blending import rasterize_to_pixels_eval3d
    from gsplat_core.poses.se3 import RollingShutterType
    from gsplat_core.rendering.alpha import FrameRenderer
    from gsplat_core.rendering.rasterization import RenderOutput, rasterization, render
    from gsplat_core.rendering.rasterizer import Rasterizer, rasterization_inria_wrapper
    from gsplat_core.rendering.renderer import Renderer, new_renderer
    from gsplat_core.rendering.surfels import rasterization_2dgs, rasterization_2dgs_inria_wrapper
    from gsplat_core.scene.cameras import Camera
    from gsplat_core.scene.collection import GaussianCollection
    from gsplat_core.scene.distortion import FThetaCameraDistortionParameters, FThetaPolynomialType
    from gsplat_core.scene.frames import Frame, FrameStatus
    from gsplat_core.scene.gaussians import Gaussians
    from gsplat_core.training.config import ReconstructorConfig
    from gsplat_core.training.reconstructor import Reconstructor
    from gsplat_core.training.steps.optimiser import SelectiveAdam
    from gsplat_core.training.strategies.adc import DefaultStrategy
    from gsplat_core.training.strategies.mcmc import MCMCStrategy
    from gsplat_core.training.strategies.strategy import Strategy

__all__ = [
    "RENDERERS",
    "Camera",
    "CoreError",
    "DefaultStrategy",
    "DeformationField",
    "FThetaCameraDistortionParameters",
    "FThetaPolynomialType",
    "Frame",
    "FrameRenderer",
    "FrameStatus",
    "GaussianCollection",
    "Gaussians",
    "InvalidInput",
    "MCMCStrategy",
    "Model",
    "PngCompression",
    "Rasterizer",
    "Reconstructor",
    "ReconstructorConfig",
    "RenderOutput",
    "Renderer",
    "RollingShutterType",
    "SelectiveAdam",
    "Snapshot",
    "SnapshotSlots",
    "Strategy",
    "UnscentedTransformParameters",
    "accumulate",
    "accumulate_2dgs",
    "export_splats",
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "fully_fused_projection_with_ut",
    "fused_ssim",
    "isect_offset_encode",
    "isect_tiles",
    "load_bundle",
    "load_ply",
    "new_renderer",
    "open_recording",
    "proj",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_2dgs",
    "rasterization_2dgs_inria_wrapper",
    "rasterization_inria_wrapper",
    "rasterize_to_indices_in_range",
    "rasterize_to_indices_in_range_2dgs",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "rasterize_to_pixels_eval3d",
    "render",
    "save_bundle",
    "save_gaussians",
    "save_ply",
    "spherical_harmonics",
    "world_to_cam",
]

_HOME = {
    "RENDERERS": "choices",
    "Camera": "scene.cameras",
    "CoreError": "errors",
    "DefaultStrategy": "training.strategies.adc",
    "DeformationField": "deformation",
    "FThetaCameraDistortionParameters": "scene.distortion",
    "FThetaPolynomialType": "scene.distortion",
    "Frame": "scene.frames",
    "FrameRenderer": "rendering.alpha",
    "FrameStatus": "scene.frames",
    "GaussianCollection": "scene.collection",
    "Gaussians": "scene.gaussians",
    "InvalidInput": "errors",
    "MCMCStrategy": "training.strategies.mcmc",
    "Model": "models",
    "PngCompression": "io.png_compression",
    "Rasterizer": "rendering.rasterizer",
    "Reconstructor": "training.reconstructor",
    "ReconstructorConfig": "training.config",
    "RenderOutput": "rendering.rasterization",
    "Renderer": "rendering.renderer",
    "RollingShutterType": "poses.se3",
    "SelectiveAdam": "training.steps.optimiser",
    "Snapshot": "models",
    "SnapshotSlots": "models",
    "Strategy": "training.strategies.strategy",
    "UnscentedTransformParameters": "ops.unscented_projection",
    "accumulate": "ops.compositing",
    "accumulate_2dgs": "ops.surfel_blending",
    "export_splats": "io.exports.export",
    "fully_fused_projection": "ops.projection",
    "fully_fused_projection_2dgs": "ops.surfel_projection",
    "fully_fused_projection_with_ut": "ops.unscented_projection",
    "fused_ssim": "ops.ssim",
    "isect_offset_encode": "ops.tiles",
    "isect_tiles": "ops.tiles",
    "load_bundle": "io.bundle",
    "load_ply": "io.ply",
    "new_renderer": "rendering.renderer",
    "open_recording": "io.recordings",
    "proj": "ops.plain_torch",
    "quat_scale_to_covar_preci": "ops.covariance",
    "rasterization": "rendering.rasterization",
    "rasterization_2dgs": "rendering.surfels",
    "rasterization_2dgs_inria_wrapper": "rendering.surfels",
    "rasterization_inria_wrapper": "rendering.rasterizer",
    "rasterize_to_indices_in_range": "ops.compositing",
    "rasterize_to_indices_in_range_2dgs": "ops.surfel_blending",
    "rasterize_to_pixels": "ops.compositing",
    "rasterize_to_pixels_2dgs": "ops.surfel_blending",
    "rasterize_to_pixels_eval3d": "ops.world_blending",
    "render": "rendering.rasterization",
    "save_bundle": "io.bundle",
    "save_gaussians": "io.exports.export",
    "save_ply": "io.ply",
    "spherical_harmonics": "ops.spherical_harmonics",
    "world_to_cam": "ops.plain_torch",
}
"""Module that defines each public name, relative to this package. `__getattr__` imports it when the name is first used."""


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(
            f"module {__name__!r} has no attribute {name!r}; for gsplat's modules and version, call"
            " gsplat_core.as_gsplat.install() and import gsplat"
        )
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
