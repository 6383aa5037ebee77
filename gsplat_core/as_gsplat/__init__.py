"""This package under gsplat's module names, so that programs written for gsplat run without a change.

`install()` makes `import gsplat` and `from gsplat.strategy import DefaultStrategy` find the functions and classes of
`gsplat_core`. `python -m gsplat_core.as_gsplat SCRIPT ...` does so and runs a program.

`MODULES` lists the modules of gsplat 1.5.3 and some of 1.6, and where `gsplat_core` defines each of their names. An import hook
serves them.
"""

from __future__ import annotations

import functools
import importlib
import importlib.abc
import importlib.machinery
import importlib.metadata
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from gsplat_core.errors import InvalidInput

__all__ = ["install"]

VERSION = "1.5.3"
"""Version of gsplat whose names and signatures the modules have."""

_FUNCTIONS = "gsplat_core.as_gsplat.functions"
_PLAIN = "gsplat_core.reference.rendering"
_OPERATIONS = "gsplat_core.training.strategies.strategy"
_STRATEGIES = {
    "DefaultStrategy": "gsplat_core.training.strategies.adc",
    "MCMCStrategy": "gsplat_core.training.strategies.mcmc",
    "Strategy": _OPERATIONS,
}
_CONTRIB = "gsplat_core.contrib"
_DISTRIBUTED = "gsplat_core.rendering.distributed"
_CUDA = {
    "FThetaCameraDistortionParameters": "gsplat_core.scene.distortion",
    "FThetaPolynomialType": "gsplat_core.scene.distortion",
    "RollingShutterType": "gsplat_core.poses.se3",
    "UnscentedTransformParameters": "gsplat_core.ops.unscented_projection",
    "fully_fused_projection": "gsplat_core.ops.projection",
    "fully_fused_projection_2dgs": "gsplat_core.ops.surfel_projection",
    "fully_fused_projection_with_ut": "gsplat_core.ops.unscented_projection",
    "isect_offset_encode": "gsplat_core.ops.tiles",
    "isect_tiles": "gsplat_core.ops.tiles",
    "proj": "gsplat_core.ops.plain_torch",
    "quat_scale_to_covar_preci": "gsplat_core.ops.covariance",
    "rasterize_to_indices_in_range": "gsplat_core.ops.compositing",
    "rasterize_to_indices_in_range_2dgs": "gsplat_core.ops.surfel_blending",
    "rasterize_to_pixels": "gsplat_core.ops.compositing",
    "rasterize_to_pixels_2dgs": "gsplat_core.ops.surfel_blending",
    "rasterize_to_pixels_eval3d": "gsplat_core.ops.world_blending",
    "spherical_harmonics": "gsplat_core.ops.spherical_harmonics",
    "world_to_cam": "gsplat_core.ops.plain_torch",
}
_RENDERING = {
    "rasterization": "gsplat_core.rendering.rasterization",
    "rasterization_2dgs": "gsplat_core.rendering.surfels",
    "rasterization_2dgs_inria_wrapper": "gsplat_core.rendering.surfels",
    "rasterization_inria_wrapper": "gsplat_core.rendering.rasterizer",
}

_ROW_OPERATIONS = {
    "_multinomial_sample": _FUNCTIONS,
    "_update_param_with_optimizer": f"{_OPERATIONS}:update_rows",
    "compute_relocation": _OPERATIONS,
    "duplicate": _OPERATIONS,
    "inject_noise_to_position": _OPERATIONS,
    "normalized_quat_to_rotmat": _FUNCTIONS,
    "quat_scale_to_covar_preci": "gsplat_core.ops.covariance",
    "relocate": _OPERATIONS,
    "remove": _OPERATIONS,
    "reset_opa": _OPERATIONS,
    "sample_add": _OPERATIONS,
    "split": _OPERATIONS,
}
_COLLECTIVES = {
    "all_gather_int32": _DISTRIBUTED,
    "all_gather_tensor_list": _DISTRIBUTED,
    "all_to_all_int32": _DISTRIBUTED,
    "all_to_all_tensor_list": _DISTRIBUTED,
}

MODULES: Mapping[str, Mapping[str, str]] = {
    "gsplat": {
        **_CUDA,
        **_RENDERING,
        **_STRATEGIES,
        "PngCompression": "gsplat_core.io.png_compression",
        "SelectiveAdam": "gsplat_core.training.steps.optimiser",
        "__version__": "gsplat_core.as_gsplat:VERSION",
        "accumulate": "gsplat_core.ops.compositing",
        "accumulate_2dgs": "gsplat_core.ops.surfel_blending",
        "export_splats": "gsplat_core.io.exports.export",
    },
    "gsplat._helper": {"load_test_data": "gsplat_core.as_gsplat.functions"},
    "gsplat.color_correct": {"color_correct_affine": _CONTRIB, "color_correct_quadratic": _CONTRIB},
    "gsplat.compression": {"PngCompression": "gsplat_core.io.png_compression"},
    "gsplat.compression.png_compression": {
        "PngCompression": "gsplat_core.io.png_compression",
        "inverse_log_transform": _FUNCTIONS,
        "log_transform": _FUNCTIONS,
    },
    "gsplat.contrib": {},
    "gsplat.contrib.dynamic": {
        "DeformNetwork": _CONTRIB,
        "DynamicStrategy": _CONTRIB,
        "HexPlaneField": _CONTRIB,
        "hexplane_regularization": _CONTRIB,
        "plane_smoothness": _CONTRIB,
        "time_l1": _CONTRIB,
        "time_smoothness": _CONTRIB,
    },
    "gsplat.contrib.dynamic.deformation": {"DeformNetwork": _CONTRIB},
    "gsplat.contrib.dynamic.hexplane": {"HexPlaneField": _CONTRIB},
    "gsplat.contrib.dynamic.regulation": {
        "hexplane_regularization": _CONTRIB,
        "plane_smoothness": _CONTRIB,
        "time_l1": _CONTRIB,
        "time_smoothness": _CONTRIB,
    },
    "gsplat.contrib.dynamic.strategy": {"DynamicStrategy": _CONTRIB},
    "gsplat.cuda": {},
    "gsplat.cuda._backend": {"_C": _FUNCTIONS},
    "gsplat.cuda._torch_impl": {
        "_eval_sh_bases_fast": _PLAIN,
        "_fisheye_proj": _PLAIN,
        "_fully_fused_projection": _PLAIN,
        "_isect_offset_encode": _PLAIN,
        "_isect_tiles": _PLAIN,
        "_ortho_proj": _PLAIN,
        "_persp_proj": _PLAIN,
        "_quat_scale_to_covar_preci": _PLAIN,
        "_quat_scale_to_matrix": _PLAIN,
        "_quat_to_rotmat": _PLAIN,
        "_rasterize_to_pixels": _PLAIN,
        "_spherical_harmonics": _PLAIN,
        "_world_to_cam": _PLAIN,
        "accumulate": "gsplat_core.ops.compositing",
    },
    "gsplat.cuda._torch_impl_2dgs": {
        "_fully_fused_projection_2dgs": _PLAIN,
        "_quat_scale_to_matrix": _PLAIN,
        "_rasterize_to_pixels_2dgs": _PLAIN,
        "accumulate_2dgs": "gsplat_core.ops.surfel_blending",
    },
    "gsplat.cuda._wrapper": {
        **_CUDA,
        "CameraModel": "gsplat_core.scene.cameras",
        "_make_lazy_cuda_func": _FUNCTIONS,
        "_make_lazy_cuda_obj": _FUNCTIONS,
        "persp_proj": f"{_PLAIN}:_persp_proj",
    },
    "gsplat.distributed": {**_COLLECTIVES, "cli": _DISTRIBUTED},
    "gsplat.exporter": {
        "export_splats": "gsplat_core.io.exports.export",
        "load_ply_to_splats": _FUNCTIONS,
        "sh2rgb": _FUNCTIONS,
        "splat2ply_bytes": _FUNCTIONS,
        "splat2splat_bytes": _FUNCTIONS,
    },
    "gsplat.init_utils": {"knn_scale_init": _CONTRIB, "multi_frame_depth_unprojection": _CONTRIB},
    "gsplat.losses": {
        "binocular_disparity_l1": _CONTRIB,
        "depth_l1_loss": _CONTRIB,
        "l1_loss": _CONTRIB,
        "masked_l1": _CONTRIB,
        "masked_ssim": _CONTRIB,
        "mse_loss": _CONTRIB,
        "opacity_reg_loss": _CONTRIB,
        "pearson_depth_loss": _CONTRIB,
        "scale_reg_loss": _CONTRIB,
        "ssim_loss": _CONTRIB,
        "total_variation_loss": _CONTRIB,
    },
    "gsplat.optimizers": {"SelectiveAdam": "gsplat_core.training.steps.optimiser"},
    "gsplat.optimizers.selective_adam": {"SelectiveAdam": "gsplat_core.training.steps.optimiser"},
    "gsplat.regularizers": {"compute_tv_loss_targeted": _CONTRIB},
    "gsplat.relocation": {"compute_relocation": _OPERATIONS},
    "gsplat.rendering": {
        **_RENDERING,
        **_CUDA,
        **_COLLECTIVES,
        "depth_to_normal": "gsplat_core.ops.depth_to_normal",
        "get_projection_matrix": _FUNCTIONS,
        "RasterizeMode": "gsplat_core.rendering.settings",
        "RenderMode": "gsplat_core.rendering.settings",
        "_rasterization": _PLAIN,
    },
    "gsplat.strategy": _STRATEGIES,
    "gsplat.strategy.base": {"Strategy": _STRATEGIES["Strategy"]},
    "gsplat.strategy.default": {**_STRATEGIES, **_ROW_OPERATIONS},
    "gsplat.strategy.mcmc": {**_STRATEGIES, **_ROW_OPERATIONS},
    "gsplat.strategy.ops": _ROW_OPERATIONS,
    "gsplat.training": {"TwoStageScheduleStep": _CONTRIB, "TwoStageScheduler": _CONTRIB},
    "gsplat.utils": {
        "depth_to_normal": "gsplat_core.ops.depth_to_normal",
        "depth_to_points": "gsplat_core.rendering.depth_maps",
        "get_projection_matrix": _FUNCTIONS,
        "inverse_log_transform": _FUNCTIONS,
        "log_transform": _FUNCTIONS,
        "normalized_quat_to_rotmat": _FUNCTIONS,
        "save_ply": _FUNCTIONS,
    },
    "gsplat.version": {"__version__": "gsplat_core.as_gsplat:VERSION"},
    "fused_ssim": {"fused_ssim": "gsplat_core.ops.ssim"},
}
"""Modules of gsplat's API with the names in each.

Each name is mapped to this package's module that defines it, or to `module:name` if the name differs there.
"""


CONSTANTS = ("1.6", "1.5.3")
_OLD_CONSTANTS: Mapping[str, Mapping[str, Any]] = {
    "accumulate": {"max_alpha": 0.999},
    "fully_fused_projection": {"compensation_floor": 0.0},
    "rasterization": {"constants": "1.5.3"},
    "rasterize_to_indices_in_range": {"max_alpha": 0.999},
    "rasterize_to_pixels": {"max_alpha": 0.999},
}
"""Defaults of options that give a function the numerical constants of gsplat 1.5.3, by function; see
`gsplat_core.rendering.settings.CONSTANTS`.
"""


class AliasModule(ModuleType):
    """Module whose attributes are imported from the modules that define them when first used."""

    __all__: list[str]

    def __init__(self, name: str, homes: Mapping[str, str], options: Mapping[str, Mapping[str, Any]]) -> None:
        super().__init__(name, f"`gsplat_core` under the name {name}.")
        self._options = options
        self._homes = dict(homes)
        self._children = [each for each in MODULES if each.rpartition(".")[0] == name]
        self.__all__ = sorted(homes)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__version__":
            raise AttributeError(name)
        full = f"{self.__name__}.{name}"
        if name in self._homes:
            home, _, known_as = self._homes[name].partition(":")
            value = _with_options(getattr(importlib.import_module(home), known_as or name), self._options.get(name))
        elif full in self._children:
            value = importlib.import_module(full)
        else:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}: {_advice(full)}")
        setattr(self, name, value)
        return value

    def __dir__(self) -> list[str]:
        return sorted([*self.__all__, *(child.rpartition(".")[2] for child in self._children)])


@functools.cache
def _bound(function: Any, options: tuple[tuple[str, Any], ...]) -> Any:
    @functools.wraps(function)
    def call(*arguments: Any, **given: Any) -> Any:
        return function(*arguments, **dict(options) | given)

    return call


def _with_options(value: Any, options: Mapping[str, Any] | None) -> Any:
    """Return the function `value` with `options` as defaults; equal arguments give the same wrapper. Without options, return `value`."""
    return value if options is None else _bound(value, tuple(options.items()))


_EXTENSION = "gsplat.csrc"
"""Module name of gsplat's compiled extension, which programs import to test whether CUDA kernels exist."""
_OF_0_1 = (
    "_torch_impl", "bin_and_sort_gaussians", "compute_cov2d_bounds", "compute_cumulative_intersects", "cov2d_bounds",
    "cuda_legacy", "get_tile_bin_edges", "map_gaussian_to_intersects", "nd_rasterize", "num_sh_bases", "project_gaussians",
    "quat_to_rotmat", "rasterize", "rasterize_gaussians", "sh",
)  # fmt: skip
"""Names of modules and functions of gsplat 0.1 that 1.5.3 does not have; their import error advises to use the newer API."""


def _advice(fullname: str) -> str:
    """Return what to use in place of a module of gsplat, or a name in one, that this package does not serve."""
    parent, _, name = fullname.rpartition(".")
    if fullname.split(".")[1] in _OF_0_1 or name in _OF_0_1:
        return (
            "it belongs to gsplat 0.1, and this package has the functions of 1.5.3; use gsplat.rasterization, or"
            " gsplat.fully_fused_projection, isect_tiles and rasterize_to_pixels, gsplat.utils.normalized_quat_to_rotmat for"
            " quat_to_rotmat, and (degree + 1) ** 2 for num_sh_bases"
        )
    known = parent if parent in MODULES else "gsplat"
    children = [each.rpartition(".")[2] for each in MODULES if each.rpartition(".")[0] == known]
    return f"{known} has {', '.join(sorted([*MODULES[known], *children]))}"


def _absent(fullname: str) -> ModuleNotFoundError:
    """Return the error about a module of gsplat, or a name in one, that this package does not serve.

    The error does not carry the name of the module, because `from gsplat import name` would then replace its message.
    """
    parent, _, name = fullname.rpartition(".")
    return ModuleNotFoundError(f"no module or name {name!r} in {parent} of gsplat_core: {_advice(fullname)}")


class _Distribution(importlib.metadata.Distribution):
    """Metadata of the package `gsplat` for programs that ask for its version."""

    def read_text(self, filename: str) -> str | None:
        """Return the content of METADATA; None for other files."""
        return f"Metadata-Version: 2.1\nName: gsplat\nVersion: {VERSION}\n" if filename == "METADATA" else None

    def locate_file(self, path: Any) -> Any:
        """Return the path of a file in the folder of this module."""
        return Path(__file__).parent / path


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Import hook that finds the modules of `MODULES` before any installed gsplat."""

    def __init__(self, constants: str) -> None:
        self.constants = constants

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of a module of `MODULES`; None for other packages.

        Raises:
            ModuleNotFoundError: for another module of gsplat.
        """
        if fullname not in MODULES:
            if fullname.startswith("gsplat.") and fullname != _EXTENSION:
                raise _absent(fullname)
            return None
        # All modules are packages, because `from gsplat.exporter import name` asks this finder about missing names only of packages.
        spec = importlib.machinery.ModuleSpec(fullname, self, origin=__file__, is_package=True)
        spec.has_location = True  # makes the import system set the module's `__file__`
        return spec

    def find_distributions(
        self, context: importlib.metadata.DistributionFinder.Context | None = None
    ) -> Iterator[importlib.metadata.Distribution]:
        """Yield the metadata of the package `gsplat` if it is asked for by name; no metadata for other packages."""
        if context is not None and context.name == "gsplat":
            yield _Distribution()

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """Create the module object without importing the modules that define its attributes."""
        return AliasModule(spec.name, MODULES[spec.name], _OLD_CONSTANTS if self.constants == "1.5.3" else {})

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: attributes are imported when they are used."""


def install(constants: str = "1.6") -> None:
    """Make `import gsplat` find this package, in this process, before any installed gsplat.

    Args:
        constants: version of gsplat whose numerical constants its functions have, "1.6" or "1.5.3". On CUDA, those of 1.6 are
            faster.

    Raises:
        ImportError: if another gsplat has been imported already, or this one with other constants.
        InvalidInput: for an unknown version.
    """
    if constants not in CONSTANTS:
        raise InvalidInput(f"unknown constants {constants!r}; the versions are {', '.join(CONSTANTS)}")
    for name in MODULES:
        loaded = sys.modules.get(name)
        if loaded is not None and not isinstance(loaded, AliasModule):
            raise ImportError(
                f"{name} has been imported from {getattr(loaded, '__file__', 'elsewhere')}; call install() before the"
                " first import of gsplat"
            )
    present = [each for each in sys.meta_path if isinstance(each, Finder)]
    if any(each.constants != constants for each in present):
        raise ImportError(f"gsplat has been installed with other constants than {constants}; call install() once")
    if not present:
        sys.meta_path.insert(0, Finder(constants))


PATH_ENTRY = str(Path(__file__).parent / "path_entry")
"""Folder whose modules install the import hook in spawned processes, which inherit `sys.path`, but not `sys.meta_path`."""
_CONSTANTS_VARIABLE = "INTRASPLAT_GSPLAT_CONSTANTS"
"""Environment variable that tells spawned processes which version's constants to use (argument of `install`)."""


def install_for_spawned_processes(constants: str) -> None:
    """Install the import hook in this process, and in the processes that `multiprocessing` starts from now on.

    Args:
        constants: see `install`.
    """
    install(constants)
    os.environ[_CONSTANTS_VARIABLE] = constants
    if PATH_ENTRY not in sys.path:
        # First in the search path: the program's own folder may contain a copy of gsplat's sources.
        sys.path.insert(0, PATH_ENTRY)


def take_over(name: str) -> None:
    """Install the import hook and import the module `name` with it, in place of the placeholder in `PATH_ENTRY` that is being
    imported.
    """
    del sys.modules[name]
    install(os.environ.get(_CONSTANTS_VARIABLE, CONSTANTS[0]))
    importlib.import_module(name)
