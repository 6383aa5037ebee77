"""Renderer that sums splats with weights instead of sorting them (Hou et al. 2024, "Sort-free Gaussian Splatting via
Weighted Sum Rendering").

A pixel is C = (w_B c_B + Σ a_i ω_i c_i) / (w_B + Σ a_i ω_i). a_i is the splat's opacity times its Gaussian, ω_i a weight
that decreases with the distance d_i, and w_B the weight of the background. The opacity is a function of the viewing
direction, a sum of spherical harmonics that is not limited to 0..1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.models import Model, Snapshot
from gsplat_core.ops.arguments import DenseProjection, TileGrid
from gsplat_core.ops.frame import OPACITY_BASES, View, render_weighted_frame
from gsplat_core.ops.projection import fully_fused_projection
from gsplat_core.ops.spherical_harmonics import spherical_harmonics
from gsplat_core.ops.tiles import bin_splats
from gsplat_core.ops.weighted_sum import weighted_sums
from gsplat_core.rendering.rasterization import RenderOutput, output_of, with_capacity
from gsplat_core.rendering.renderer import (
    STANDARD_OUTPUTS,
    Capabilities,
    FinishedFrame,
    PendingFrame,
    Precision,
    check_camera,
    check_trained_by,
    checked_outputs,
)
from gsplat_core.rendering.settings import EPS2D, TILE_SIZE
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import SH_C0, Gaussians

OPACITY, FACTOR = "opacity_sh", "distance_factor"
"""Names of the renderer's tensors in `Gaussians.extra`: harmonics of the opacity [N, 16], and v_i [N]."""
OPACITY_DEGREE = 3
ROWS_AT_ONCE = 1 << 22
"""Number of Gaussians whose opacities are evaluated at once."""
LEAST_TOTAL = 1e-2
"""Lower limit of the sum of all weights at a pixel. Opacities may be negative, and so may their sum."""
LEAST_SHARE = 1e-4
"""Smallest sum of the splats' weights at which a pixel has a depth; below it the depth is unknown (0)."""


class WeightedSumRenderer:
    """Renderer with the weights ω = v_i max(0, 1 - d/σ), the best of the three in the paper. Learned: σ and w_B for the
    scene, v_i and the harmonics of the opacity for each Gaussian.

    The picture is independent of the order of the Gaussians, so nothing pops when the camera turns. The Gaussians'
    `logit_opacities` are not used. On CUDA without gradients one op renders the whole frame.
    """

    name: ClassVar[str] = "weighted_sum"
    capabilities = Capabilities(
        outputs=STANDARD_OUTPUTS,
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=True,
        deterministic=True,
    )
    rates: ClassVar[Mapping[str, float]] = {OPACITY: 1e-2, FACTOR: 1e-2, "sigma": 5e-3, "background": 1e-2}
    """Learning rates, by name, of the tensors in `Gaussians.extra` and of the logarithms of the scene-wide scalars; values
    without an entry are not trained.
    """

    has_whole_frame: ClassVar[bool] = True
    """True if the op `render_weighted_frame` renders the pictures of this class on a GPU, False if it has other weights."""

    def __init__(
        self, camera: Camera, device: torch.device, *, precision: Precision = "fp32", background: Tensor | None = None
    ) -> None:
        self._camera, self._device, self._background = camera, torch.device(device), background
        self._model: Model | None = None
        self._values: dict[str, Tensor] = {}

    def prepare(self, model: Model | Snapshot) -> None:
        """Set the model of the following frames. Raises InvalidInput for a model on another device, InvalidSetting for
        one of another renderer.
        """
        if model.device.type != self._device.type:
            raise InvalidInput(f"this renderer is made for {self._device.type}, the model is on {model.device}")
        check_trained_by(self.name, model, self.name)
        if model is self._model:
            return
        self._model = model = model.as_model()
        self._values = {
            name: torch.full((), value, device=model.device) for name, value in model.trained_by.values.items()
        }

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        """Enqueue the picture of the prepared model; see `Renderer.render`."""
        asked = checked_outputs(self.name, outputs, self.capabilities)
        check_camera(self._camera, camera)
        if self._model is None:
            raise InvalidInput("no model was prepared; call prepare(model) before render()")
        with torch.no_grad():
            output = self.picture(
                self._model.at(time_s), camera, self._background, self._values, depth="depth" in asked
            )
        return FinishedFrame({name: tensor for name, tensor in output._asdict().items() if name in asked})

    @classmethod
    def extended(cls, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the renderer's tensors. Missing ones start with the present opacity in all
        directions and v_i = 1.
        """
        extra = dict(gaussians.extra)
        if OPACITY not in extra:
            extra[OPACITY] = gaussians.means.new_zeros(gaussians.count, OPACITY_BASES)
            extra[OPACITY][:, 0] = gaussians.opacities.detach() / SH_C0
        if FACTOR not in extra:
            extra[FACTOR] = gaussians.means.new_ones(gaussians.count)
        return replace(gaussians, extra=extra)

    @classmethod
    def first_values(cls, distance: float) -> dict[str, float]:
        """Return initial values, all positive, of the renderer's scalars for the whole scene, by name.

        Args:
            distance: typical distance from the camera to the scene, in the scene's unit.
        """
        return {"sigma": 2 * distance, "background": 0.1, "distance": distance}

    @classmethod
    def weights(cls, depths: Tensor, gaussians: Gaussians, values: Mapping[str, Tensor]) -> Tensor:
        """Return the blending weights ω [N] of the Gaussians at the camera depths [N]."""
        return (1 - depths / values["sigma"]).clamp(min=0) * gaussians.extra[FACTOR]

    @classmethod
    def picture(
        cls,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor | None,
        values: Mapping[str, Tensor],
        depth: bool = True,
    ) -> RenderOutput:
        """Render a differentiable picture; see `TrainableRenderer.picture`."""
        viewmat, intrinsics = camera.matrices(gaussians.device, gaussians.dtype)
        if cls.has_whole_frame and _is_whole_frame(gaussians, background, values):
            view = View(viewmat, intrinsics, camera.width_px, camera.height_px, background, camera.model)
            scalars = values["sigma"], values["distance"], values["background"]
            draw = lambda capacity: render_weighted_frame(
                gaussians.left_tensors, gaussians.extra[OPACITY], gaussians.extra[FACTOR], scalars, view, capacity,
                least_total=LEAST_TOTAL, least_share=LEAST_SHARE,
            )  # fmt: skip
            return output_of(with_capacity(gaussians.count, draw), depth)
        position = torch.as_tensor(camera.position, dtype=gaussians.dtype).to(gaussians.device, non_blocking=True)
        directions = gaussians.means - position
        opacities = _opacities(gaussians.extra[OPACITY], directions)
        reach = opacities.detach().abs().clamp(max=1)
        size = camera.width_px, camera.height_px
        rows = fully_fused_projection(
            gaussians.means, None, gaussians.quats, gaussians.scales, viewmat[None], intrinsics[None], *size,
            eps2d=EPS2D, camera_model=camera.model, opacities=reach,
        )  # fmt: skip
        assert isinstance(rows, DenseProjection)
        grid = TileGrid(TILE_SIZE, *(-(-side // TILE_SIZE) for side in size))
        # The lists are ordered by depth, as for alpha blending; the sums do not depend on the order.
        _, ids, offsets = bin_splats(
            rows.means2d, rows.radii, rows.depths, grid, conics=rows.conics, opacities=reach[None]
        )
        channels = (spherical_harmonics(gaussians.sh_degree, directions, gaussians.sh) + 0.5).clamp(min=0)
        if depth:
            channels = torch.cat([channels, (rows.depths[0] / values["distance"])[:, None]], 1)
        weights = cls.weights(rows.depths[0], gaussians, values)
        sums = weighted_sums(rows.means2d[0], rows.conics[0], channels, opacities, weights, *size, offsets[0], ids)
        behind = values["background"]
        total = (sums[-1] + behind).clamp(min=LEAST_TOTAL)
        image = sums[:3] if background is None else sums[:3] + (behind * background)[:, None, None]
        alpha = 1 - (behind / total).clamp(max=1)
        z = torch.zeros_like(alpha)
        if depth:
            known = sums[-1] > LEAST_SHARE
            z = torch.where(known, sums[3] / torch.where(known, sums[-1], 1.0), 0.0) * values["distance"]
        return RenderOutput((image / total).permute(1, 2, 0).contiguous(), alpha, z)


def _is_whole_frame(gaussians: Gaussians, background: Tensor | None, values: Mapping[str, Tensor]) -> bool:
    """Return True for a picture on CUDA without gradients, which one op renders."""
    if gaussians.device.type != "cuda" or gaussians.dtype != torch.float32:
        return False
    tensors = (*gaussians.left_tensors, *gaussians.extra.values(), *values.values(), background)
    return not (torch.is_grad_enabled() and any(t.requires_grad for t in tensors if t is not None))


def _opacities(harmonics: Tensor, directions: Tensor) -> Tensor:
    """Return the opacities [N] in directions [N, 3]."""
    # The op evaluates three channels, of which two are unused. The parts limit the memory of the copies.
    parts = zip(harmonics.split(ROWS_AT_ONCE), directions.split(ROWS_AT_ONCE), strict=True)
    found = [
        spherical_harmonics(OPACITY_DEGREE, along, rows[..., None].expand(-1, -1, 3))[:, 0] for rows, along in parts
    ]
    return found[0] if len(found) == 1 else torch.cat(found)


class DirectWeightedSumRenderer(WeightedSumRenderer):
    """Weighted-sum renderer in which every weight ω is 1."""

    name: ClassVar[str] = "weighted_sum_direct"
    has_whole_frame: ClassVar[bool] = False
    rates: ClassVar[Mapping[str, float]] = {OPACITY: 1e-2, "background": 1e-2}

    @classmethod
    def first_values(cls, distance: float) -> dict[str, float]:
        """Return initial values of the scene-wide scalars, by name. No scalar belongs to the weights, which are constant."""
        return {"background": 0.1, "distance": distance}

    @classmethod
    def weights(cls, depths: Tensor, gaussians: Gaussians, values: Mapping[str, Tensor]) -> Tensor:
        """Return the weights ω [N], all 1."""
        return torch.ones_like(depths)


class ExpWeightedSumRenderer(WeightedSumRenderer):
    """Weighted-sum renderer with ω = exp(-σ (d/D)^β). D is the typical camera distance before training. σ and β are
    learned for the scene.
    """

    name: ClassVar[str] = "weighted_sum_exp"
    has_whole_frame: ClassVar[bool] = False
    rates: ClassVar[Mapping[str, float]] = {OPACITY: 1e-2, "sigma": 5e-3, "beta": 5e-3, "background": 1e-2}

    @classmethod
    def first_values(cls, distance: float) -> dict[str, float]:
        """Return initial values of the scene-wide scalars, by name, with σ = 1 and β = 1."""
        return {**super().first_values(distance), "sigma": 1.0, "beta": 1.0}

    @classmethod
    def weights(cls, depths: Tensor, gaussians: Gaussians, values: Mapping[str, Tensor]) -> Tensor:
        """Return the weights ω [N] of the Gaussians at the camera depths [N]."""
        return torch.exp(-values["sigma"] * (depths.clamp(min=0) / values["distance"] + 1e-12) ** values["beta"])
