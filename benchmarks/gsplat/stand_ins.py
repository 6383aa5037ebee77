"""Small replacements for packages that gsplat's example trainer imports and the machine lacks.

`install()` tries to import each package, and registers a module of the same name where that fails. A replacement has only
what the trainer uses. LPIPS is always replaced, because its weights are a download; it is not measured.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsplat_core.io.recordings.colmap import read_colmap
from gsplat_core.ops.ssim import fused_ssim

LPIPS = "torchmetrics.image.lpip"


def config_of_command_line(configs: Mapping[str, tuple[str, Any]]) -> Any:
    """Return the configuration that the first argument names, with the values of the further arguments.

    Flags are names of fields, with `.` before the field of a nested object, `_` or `-` between words, and `--no-` before
    the name of a boolean to set it to False.
    """
    name, *words = sys.argv[1:]
    config = configs[name][1]
    flags: list[tuple[str, list[str]]] = []
    for word in words:
        if word.startswith("--"):
            flags.append((word[2:].replace("-", "_"), []))
        else:
            flags[-1][1].append(word)
    for flag, values in flags:
        *owners, field = flag.split(".")
        owner = config
        for each in owners:
            owner = getattr(owner, each)
        if not values:
            off = field.startswith("no_") and not hasattr(owner, field)
            field, value = field.removeprefix("no_") if off else field, not off
        else:
            value = _parsed(values, getattr(owner, field))
        if not hasattr(owner, field):
            raise SystemExit(f"{type(owner).__name__} has no field {field!r}")
        setattr(owner, field, value)
    return config


def _parsed(values: Sequence[str], present: Any) -> Any:
    """Return values with the type of the present value."""
    if isinstance(present, list):
        return [type(present[0])(value) for value in values]
    return values[0] if present is None else type(present)(values[0])


class Reconstruction:
    """Cameras, images and points of a COLMAP scene, without the observations of points."""

    def __init__(self, folder: str) -> None:
        scene = read_colmap(Path(folder).parents[1] if Path(folder).parent.name == "sparse" else Path(folder))
        self.cameras: dict[int, SimpleNamespace] = {}
        self.images: dict[int, SimpleNamespace] = {}
        known: dict[tuple[Any, ...], int] = {}
        for number, posed in enumerate(scene.images, 1):
            camera = posed.camera
            K = np.array(camera.K, np.float64)
            key = (K.tobytes(), camera.width_px, camera.height_px)
            identity = known.setdefault(key, len(known) + 1)
            self.cameras[identity] = SimpleNamespace(
                calibration_matrix=K.copy, model="PINHOLE", width=camera.width_px, height=camera.height_px
            )
            self.images[number] = SimpleNamespace(
                name=posed.name, camera_id=identity, cam_from_world=_pose(np.array(camera.world_to_camera, np.float64)[:3]),
                get_observation_points2D=list,
            )  # fmt: skip
        positions, colors = scene.points()
        self.points3D = {
            number: SimpleNamespace(xyz=xyz, color=color, error=0.0)
            for number, (xyz, color) in enumerate(zip(positions, colors, strict=True), 1)
        }


def _pose(matrix: NDArray[np.float64]) -> Callable[[], SimpleNamespace]:
    return lambda: SimpleNamespace(matrix=matrix.copy)


class Neighbours:
    """Distances to the nearest points."""

    def __init__(self, n_neighbors: int, metric: str = "euclidean") -> None:
        self.count = n_neighbors
        self.points = torch.empty(0, 3)

    def fit(self, points: NDArray[np.float32]) -> Neighbours:
        """Store the points [N, 3]."""
        self.points = torch.from_numpy(points)
        return self

    def kneighbors(self, queries: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Return distances and indices [M, K], nearest first."""
        parts = [
            torch.cdist(part, self.points, compute_mode="donot_use_mm_for_euclid_dist").topk(self.count, largest=False)
            for part in torch.from_numpy(queries).split(1000)
        ]
        return torch.cat([part.values for part in parts]).numpy(), torch.cat([part.indices for part in parts]).numpy()


class Psnr(torch.nn.Module):
    """PSNR of pictures in 0..1."""

    def __init__(self, data_range: float) -> None:
        super().__init__()

    def forward(self, shown: Tensor, wanted: Tensor) -> Tensor:
        """Return the value of pictures [B, 3, H, W]."""
        return -10 * (shown - wanted).square().mean().log10()


class Ssim(torch.nn.Module):
    """SSIM of pictures in 0..1 with a Gaussian window of 11 px, without the border."""

    def __init__(self, data_range: float) -> None:
        super().__init__()

    def forward(self, shown: Tensor, wanted: Tensor) -> Tensor:
        """Return the value of pictures [B, 3, H, W]."""
        return fused_ssim(shown, wanted, padding="valid", train=False)


class NotMeasured(torch.nn.Module):
    """Metric whose value is always NaN."""

    def __init__(self, **options: Any) -> None:
        super().__init__()

    def forward(self, shown: Tensor, wanted: Tensor) -> Tensor:
        """Return NaN."""
        return shown.new_full((), torch.nan)


class Writer:
    """Writer that keeps nothing."""

    def __init__(self, log_dir: str) -> None: ...

    def add_scalar(self, name: str, value: float, step: int) -> None: ...

    def add_image(self, name: str, picture: Any, step: int) -> None: ...

    def flush(self) -> None: ...


class Progress:
    """Iterator without a progress bar."""

    def __init__(self, items: Any, desc: str = "") -> None:
        self.items = items

    def __iter__(self) -> Iterator[Any]:
        return iter(self.items)

    def set_description(self, text: str) -> None:
        """Do nothing."""


def _read_picture(path: str) -> NDArray[np.uint8]:
    return np.ascontiguousarray(np.asarray(cv2.imread(path, cv2.IMREAD_COLOR), np.uint8)[..., ::-1])


def _write_picture(path: str, picture: NDArray[np.uint8]) -> None:
    cv2.imwrite(path, picture[..., ::-1])


REPLACEMENTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "imageio.v2": {name: {"imread": _read_picture, "imwrite": _write_picture} for name in ("imageio", "imageio.v2")},
    "tqdm": {"tqdm": {"tqdm": Progress, "trange": lambda count, desc="": Progress(range(count))}},
    "tyro": {"tyro": {"extras": SimpleNamespace(overridable_config_cli=config_of_command_line)}},
    "pycolmap": {
        "pycolmap": {
            "Reconstruction": Reconstruction,
            "CameraModelId": SimpleNamespace(SIMPLE_PINHOLE="SIMPLE_PINHOLE", PINHOLE="PINHOLE"),
        }
    },
    "torchmetrics.image": {
        "torchmetrics": {},
        "torchmetrics.image": {"PeakSignalNoiseRatio": Psnr, "StructuralSimilarityIndexMeasure": Ssim},
    },
    "sklearn.neighbors": {"sklearn": {}, "sklearn.neighbors": {"NearestNeighbors": Neighbours}},
    "torch.utils.tensorboard": {"torch.utils.tensorboard": {"SummaryWriter": Writer}},
    "fused_ssim": {"fused_ssim": {"fused_ssim": fused_ssim}},
}
"""Modules, with their attributes, that take the place of the module named first if it cannot be imported."""


def install() -> list[str]:
    """Register the replacements that are needed, and return the modules that they replace."""
    replaced = []
    for wanted, modules in REPLACEMENTS.items():
        try:
            importlib.import_module(wanted)
        except Exception as error:  # noqa: BLE001 - an installed package may fail in its own ways
            print(f"replaced {wanted}: {type(error).__name__}: {error}")
            replaced.append(wanted)
            for name, attributes in modules.items():
                _register(name, attributes)
    _register(LPIPS, {"LearnedPerceptualImagePatchSimilarity": NotMeasured})
    return [*replaced, LPIPS]


def _register(name: str, attributes: Mapping[str, Any]) -> None:
    module = ModuleType(name)
    module.__path__, module.__spec__ = [], ModuleSpec(name, None)
    vars(module).update(attributes)
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], child, module)
