"""Public names and signatures; a change here breaks users."""

from __future__ import annotations

import importlib
import inspect
import subprocess
import sys

import pytest

import gsplat_core
from gsplat_core import reference

PUBLIC = [
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
    "RENDERERS",
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

# gsplat 1.5.3, in its order.
RASTERIZATION = (
    "means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree packed"
    " tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed camera_model segmented"
    " covars with_ut with_eval3d radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs rolling_shutter viewmats_rs"
)
SIGNATURES = {
    "rasterization": RASTERIZATION,
    "fully_fused_projection": (
        "means covars quats scales viewmats Ks width height eps2d near_plane far_plane radius_clip packed sparse_grad"
        " calc_compensations camera_model opacities"
    ),
    "isect_tiles": (
        "means2d radii depths tile_size tile_width tile_height sort segmented packed n_images image_ids gaussian_ids"
    ),
    "isect_offset_encode": "isect_ids n_images tile_width tile_height",
    "rasterize_to_pixels": (
        "means2d conics colors opacities image_width image_height tile_size isect_offsets flatten_ids backgrounds masks"
        " packed absgrad"
    ),
    "spherical_harmonics": "degrees_to_use dirs coeffs masks",
    "quat_scale_to_covar_preci": "quats scales compute_covar compute_preci triu",
    "fully_fused_projection_2dgs": (
        "means quats scales viewmats Ks width height eps2d near_plane far_plane radius_clip packed sparse_grad"
    ),
    "rasterize_to_pixels_2dgs": (
        "means2d ray_transforms colors opacities normals densify image_width image_height tile_size isect_offsets"
        " flatten_ids backgrounds masks packed absgrad distloss"
    ),
}


def test_public_names_match_expected_list():
    assert sorted(gsplat_core.__all__) == PUBLIC
    assert set(PUBLIC) <= set(dir(gsplat_core))
    for name in PUBLIC:
        module = importlib.import_module(f"gsplat_core.{gsplat_core._HOME[name]}")
        assert getattr(gsplat_core, name) is getattr(module, name)


def test_signatures_match_gsplat_in_package_and_reference():
    for name, expected in SIGNATURES.items():
        for home in (gsplat_core, reference):
            parameters = inspect.signature(getattr(home, name)).parameters
            names = expected.split()
            assert list(parameters)[: len(names)] == names, (home.__name__, name)
            # What is ours beyond gsplat's comes by keyword only.
            extra = list(parameters.values())[len(names) :]
            assert all(p.kind is p.KEYWORD_ONLY for p in extra), (home.__name__, name)


def test_rasterization_accepts_gsplat_arguments_by_position():
    parameters = inspect.signature(gsplat_core.rasterization).parameters
    for name in RASTERIZATION.split():
        assert parameters[name].kind is inspect.Parameter.POSITIONAL_OR_KEYWORD, name


def test_rasterization_constants_keyword_defaults_to_1_6():
    for home in (gsplat_core, reference):
        *_, constants = inspect.signature(home.rasterization).parameters.values()
        assert (constants.name, constants.kind, constants.default) == (
            "constants",
            inspect.Parameter.KEYWORD_ONLY,
            "1.6",
        )


def test_unknown_name_raises_attribute_error():
    try:
        gsplat_core.rasterisation  # noqa: B018
    except AttributeError as error:
        assert "rasterisation" in str(error)
    else:
        raise AssertionError("an unknown name was found")


@pytest.mark.slow
def test_reference_works_without_compiled_library():
    program = (
        "import pathlib, sys\n"
        "from pathlib import Path\n"
        "exists = Path.exists\n"
        "Path.exists = lambda self: self.suffix != '.so' and exists(self)\n"
        "from gsplat_core import reference, errors\n"
        "import torch\n"
        "assert reference.quat_scale_to_covar_preci(torch.ones(2, 4), torch.ones(2, 3))[0].shape == (2, 3, 3)\n"
        "import gsplat_core\n"
        "try:\n"
        "    gsplat_core.rasterization\n"
        "except errors.NativeLibraryMissing as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "make native" in done.stdout
