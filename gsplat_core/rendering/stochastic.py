"""Renderers that draw random samples, without sorting, for very large models.

Stochastic transparency (StochasticSplats, ICCV 2025) samples the splats of each pixel. Gaussian point splatting (Rijsdijk et
al., TOG 2026) draws random points of each Gaussian. Scenes have three formats: without a copy, precomputed, and quantised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ClassVar

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput, InvalidSetting
from gsplat_core.models import Model, Snapshot
from gsplat_core.ops.covariance import quat_scale_to_covar_preci
from gsplat_core.ops.native import CUDA_MISSING
from gsplat_core.ops.stochastic import (
    CHUNK,
    CHUNK_FLOATS,
    COLOUR_CHUNK,
    Method,
    SplatScene,
    new_sums,
    picture_of,
    sample_splats,
)
from gsplat_core.rendering.renderer import (
    PROGRESSIVE_SAMPLES,
    STANDARD_OUTPUTS,
    Capabilities,
    FinishedFrame,
    PendingFrame,
    Precision,
    RendererOptions,
    Storage,
    check_camera,
    check_trained_by,
    checked_outputs,
)
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.gaussians import Gaussians

ALPHA_CUTOFF = 1.0 / 255.0
ROWS_AT_ONCE = 1 << 20
"""Number of Gaussians processed at once, which limits temporary memory."""


def raw_splats(gaussians: Gaussians) -> SplatScene:
    """Return a scene that shares the memory of raw Gaussians; needs no preparation when they move."""
    return SplatScene(
        means=gaussians.means,
        quats=gaussians.quats,
        log_scales=gaussians.log_scales,
        logits=gaussians.logit_opacities,
        sh=gaussians.sh,
    )


def prepared_splats(gaussians: Gaussians) -> SplatScene:
    """Precompute covariances and opacities, and drop splats with an opacity below 1/255.

    The rows keep the random numbers of their index in `gaussians`. Means and colours are shared if nothing is dropped.
    """
    opacities = gaussians.opacities
    kept = (opacities >= ALPHA_CUTOFF).nonzero()[:, 0]
    index = None
    if len(kept) < gaussians.count:
        index = kept.to(torch.int32)
        gaussians, opacities = gaussians.select(kept), opacities[kept]
    covars = gaussians.means.new_empty(gaussians.count, 6)
    for rows in _steps(gaussians.count):
        some, _ = quat_scale_to_covar_preci(
            gaussians.quats[rows], gaussians.log_scales[rows].exp(), compute_preci=False, triu=True
        )
        assert some is not None
        covars[rows] = some
    return SplatScene(means=gaussians.means, covars=covars, opacities=opacities, sh=gaussians.sh, file_index=index)


def quantised_splats(gaussians: Gaussians) -> SplatScene:
    """Quantise Gaussians to 16 bytes each, plus three bytes (one per colour) per further spherical-harmonics coefficient.

    Splats with an opacity below 1/255 are dropped. The others are sorted along a Morton curve. Positions and log-scales
    are stored relative to their ranges in chunks of `CHUNK` neighbours, colours relative to those of `COLOUR_CHUNK`
    neighbours, and higher bands relative to one range per band and chunk. Rows keep the random numbers of their index
    in `gaussians`.
    """
    kept = (gaussians.opacities >= ALPHA_CUTOFF).nonzero()[:, 0]
    order = kept[morton_codes(gaussians.means[kept]).argsort(stable=True)]
    count, bases = len(order), gaussians.sh.shape[1]
    device = gaussians.device
    chunks = torch.zeros((count + CHUNK - 1) // CHUNK, CHUNK_FLOATS, device=device)
    packed = torch.empty(count, 4, dtype=torch.int32, device=device)
    packed_sh = torch.empty(count, bases - 1, 3, dtype=torch.uint8, device=device) if bases > 1 else None
    for number in range(len(chunks)):
        rows = slice(number * CHUNK, min((number + 1) * CHUNK, count))
        some = gaussians.select(order[rows])
        ranges = chunks[number]
        position = _steps_of(some.means, 65535, ranges, 0)
        scales = _steps_of(some.log_scales, 255, ranges, 6)
        most = torch.tensor([31, 63, 31], device=device)
        colours = _to_brightness(some.sh[:, 0]).split(COLOUR_CHUNK)
        colour = torch.cat([_steps_of(few, most, ranges, 20 + 6 * k) for k, few in enumerate(colours)])
        opacity = (some.opacities * 255).round().long().clamp(1, 255)
        words = [
            position[:, 0] | position[:, 1] << 16,
            position[:, 2] | scales[:, 0] << 16 | scales[:, 1] << 24,
            _rotation_words(some.quats),
            scales[:, 2] | opacity << 8 | (colour[:, 0] | colour[:, 1] << 5 | colour[:, 2] << 11) << 16,
        ]
        packed[rows] = _as_int32(torch.stack(words, -1))
        for band in range(1, gaussians.sh_degree + 1):
            values = some.sh[:, band * band : (band + 1) ** 2]
            low, high = values.amin(), values.amax()
            step = (high - low).clamp_min(1e-12) / 255
            ranges[10 + 2 * band], ranges[11 + 2 * band] = low, step
            assert packed_sh is not None
            packed_sh[rows, band * band - 1 : (band + 1) ** 2 - 1] = ((values - low) / step).round().to(torch.uint8)
    return SplatScene(file_index=order.to(torch.int32), packed=packed, chunks=chunks, packed_sh=packed_sh)


def morton_codes(means: Tensor) -> Tensor:
    """Return the position of each point [N, 3] on a Morton curve with 2^21 cells per axis, int64 [N]."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64, device=means.device)
    low, high = means.amin(0), means.amax(0)
    cells = ((means - low) / (high - low).clamp_min(1e-12) * ((1 << 21) - 1)).long()
    code = torch.zeros(len(means), dtype=torch.int64, device=means.device)
    for axis in range(3):
        x = cells[:, axis]
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            x = (x | x << shift) & mask
        code |= x << axis
    return code


def _steps(count: int) -> list[slice]:
    return [slice(first, min(first + ROWS_AT_ONCE, count)) for first in range(0, count, ROWS_AT_ONCE)]


def _steps_of(values: Tensor, most: Tensor | int, ranges: Tensor, offset: int) -> Tensor:
    """Quantise each column of `values` [n, 3] to whole numbers 0..most, returned as int64. Write the columns' minima and step
    sizes to `ranges` from `offset` on.
    """
    low, high = values.amin(0), values.amax(0)
    step = (high - low).clamp_min(1e-12) / most
    ranges[offset : offset + 3], ranges[offset + 3 : offset + 6] = low, step
    return ((values - low) / step).round().long()


def _rotation_words(quats: Tensor) -> Tensor:
    """Pack each quaternion into 32 bits: 2 for the index of its largest component, 10 for each other one, int64 [n]."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    largest = unit.abs().argmax(-1, keepdim=True)
    unit = unit * unit.gather(-1, largest).sign()
    others = torch.arange(4, device=quats.device).expand(len(quats), 4)
    others = others[others != largest].view(-1, 3)
    steps = ((unit.gather(-1, others) * 2**0.5 + 1) * 511).round().long().clamp(0, 1022)
    return largest[:, 0] | steps[:, 0] << 2 | steps[:, 1] << 12 | steps[:, 2] << 22


def _to_brightness(colours: Tensor) -> Tensor:
    """Return (green - red) / 2, (red + green + blue) / 3, and blue / 2 - (red + green) / 4 of colours [n, 3]."""
    red, green, blue = colours.unbind(-1)
    return torch.stack([(green - red) / 2, colours.mean(-1), blue / 2 - (red + green) / 4], -1)


def _from_brightness(values: Tensor) -> Tensor:
    """Return the RGB colours [n, 3] from which `_to_brightness` computed `values`."""
    grey = values[:, 1] - values[:, 2] * (2 / 3)
    return torch.stack([grey - values[:, 0], grey + values[:, 0], values[:, 1] + values[:, 2] * (4 / 3)], -1)


def _as_int32(words: Tensor) -> Tensor:
    return torch.where(words >= 1 << 31, words - (1 << 32), words).to(torch.int32)


def dequantised(scene: SplatScene) -> Gaussians:
    """Return the Gaussians that the kernels decode from quantised splats, in the scene's order."""
    assert scene.packed is not None and scene.chunks is not None
    words = scene.packed.long() & 0xFFFFFFFF
    rows = torch.arange(len(words), device=words.device)
    ranges = scene.chunks[rows // CHUNK]
    field = lambda word, shift, bits: (words[:, word] >> shift) & ((1 << bits) - 1)
    scaled = lambda offset, *steps: (
        ranges[:, offset : offset + 3] + ranges[:, offset + 3 : offset + 6] * torch.stack(steps, -1)
    )
    means = scaled(0, field(0, 0, 16), field(0, 16, 16), field(1, 0, 16))
    log_scales = scaled(6, field(1, 16, 8), field(1, 24, 8), field(3, 0, 8))
    places = 20 + 6 * (rows % CHUNK // COLOUR_CHUNK)[:, None] + torch.arange(6, device=words.device)
    low, step = ranges.gather(1, places).split(3, 1)
    colour = _from_brightness(low + step * torch.stack([field(3, 16, 5), field(3, 21, 6), field(3, 27, 5)], -1))
    others = (torch.stack([field(2, 2 + 10 * k, 10) for k in range(3)], -1) * (2 / 1022) - 1) * 0.5**0.5
    most = (1 - others.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()
    largest = field(2, 0, 2)[:, None]
    components = torch.arange(4, device=words.device).expand(len(words), 4)
    quats = torch.empty(len(words), 4, device=words.device).scatter_(1, largest, most)
    quats.scatter_(1, components[components != largest].view(-1, 3), others)
    sh = colour[:, None]
    if scene.packed_sh is not None:
        bands = [0] * 3 + [1] * 5 + [2] * 7 + [3] * 9
        band = torch.tensor(bands[: scene.packed_sh.shape[1]], device=words.device)
        rest = ranges[:, 12 + 2 * band, None] + ranges[:, 13 + 2 * band, None] * scene.packed_sh
        sh = torch.cat([sh, rest], 1)
    logits = torch.logit(field(3, 8, 8) / 255, eps=1e-6)
    return Gaussians(means, quats, log_scales, logits, sh)


STORAGES: dict[Storage, Callable[[Gaussians], SplatScene]] = {
    "raw": raw_splats,
    "prepared": prepared_splats,
    "quantised": quantised_splats,
}


class SampledRenderer:
    """Renderer that averages random samples of a scene; base of `StochasticRenderer` and `PointRenderer`.

    The outputs are `image`, `alpha` (share of samples that hit a splat) and `depth` (mean z of these samples). Memory in
    addition to the model is the frame buffer and a queue of fixed size, for any number of Gaussians.
    """

    name: ClassVar[str]
    method: ClassVar[Method]
    capabilities: ClassVar[Capabilities]

    def __init__(
        self,
        camera: Camera,
        device: torch.device,
        *,
        precision: Precision = "fp32",
        background: Tensor | None = None,
        options: RendererOptions | None = None,
    ) -> None:
        self._options = options or RendererOptions()
        if self._options.order == "pixel" and camera.model != "pinhole":
            raise InvalidSetting(f"order pixel needs a pinhole camera, not {camera.model}; choose order splat")
        if device.type == "cuda" and CUDA_MISSING is not None:
            raise InvalidSetting(f"renderer {self.name!r} needs the CUDA kernels, which are {CUDA_MISSING}")
        self._camera, self._device, self._background = camera, device, background
        self._model: Model | None = None
        self._scene: SplatScene | None = None
        """Splats of the prepared model in the chosen storage format; None for a moving model, converted in each frame."""
        self._sums: Tensor | None = None
        """Sums [H, W, 5] of the samples of the picture so far; see `sample_splats`. Progressive frames continue them."""
        self._drawn = 0
        """Number of samples per sub-pixel in `_sums`."""
        self._shown: tuple[Model, Camera, float] | None = None

    @property
    def samples_drawn(self) -> int:
        """Number of samples per sub-pixel in the last picture, including those accumulated over earlier progressive frames of
        the same view.
        """
        return self._drawn

    def prepare(self, model: Model | Snapshot) -> None:
        """Set the model of the following frames. Raises InvalidInput for a model on another device, InvalidSetting for
        one of a renderer other than `alpha` or, unless the storage is `raw`, one that moves.
        """
        if model.device.type != self._device.type:
            raise InvalidInput(f"this renderer is made for {self._device.type}, the model is on {model.device}")
        check_trained_by(self.name, model)
        model = model.as_model()
        if self._options.storage != "raw" and model.field is not None:
            raise InvalidSetting(
                f"storage {self._options.storage} needs a model that does not move; choose storage raw"
            )
        self._model, self._scene = model, None
        if model.field is None:
            with torch.no_grad():
                self._scene = STORAGES[self._options.storage](model.gaussians)

    def render(self, camera: Camera, time_s: float, outputs: Iterable[str] = STANDARD_OUTPUTS) -> PendingFrame:
        """Enqueue the sampled picture of the prepared model; see `Renderer.render`."""
        asked = checked_outputs(self.name, outputs, self.capabilities)
        check_camera(self._camera, camera)
        if self._model is None:
            raise InvalidInput("no model was prepared; call prepare(model) before render()")
        with torch.no_grad():
            static = self._model.field is None
            shown = self._model, camera, 0.0 if static else self._model.clamp_time(time_s)
            if self._sums is None or not self._options.progressive or shown != self._shown:
                self._sums, self._drawn, self._shown = new_sums(camera, self._model.device), 0, shown
            if self._drawn < PROGRESSIVE_SAMPLES or not self._options.progressive:
                self._sample(self._scene or raw_splats(self._model.at(time_s)), camera, self._sums)
                self._drawn += self._options.samples
            factor = self._options.supersampling
            picture = picture_of(self._sums, self._drawn * factor * factor, self._background)
        return FinishedFrame({name: tensor for name, tensor in picture._asdict().items() if name in asked})

    def _sample(self, scene: SplatScene, camera: Camera, sums: Tensor) -> None:
        options = self._options
        sample_splats(
            scene,
            camera,
            sums,
            method=self.method,
            first_sample=self._drawn,
            samples=options.samples,
            supersampling=options.supersampling,
            seed=options.seed,
            pixel_order=options.order == "pixel",
        )


class StochasticRenderer(SampledRenderer):
    """Renderer in which every covered pixel draws against each splat's alpha; its expectation is alpha blending.

    The standard error halves with four times the samples. `order="pixel"` orders splats by their planes' depth at each
    pixel, which removes popping.
    """

    name = "stochastic"
    method = "fragments"
    capabilities = Capabilities(
        outputs=STANDARD_OUTPUTS,
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "supersampling", "order", "seed", "progressive", "storage"),
    )


class PointRenderer(SampledRenderer):
    """Renderer that draws a Poisson number of points from every splat and keeps the nearest one of each sub-pixel.

    Its expectation is alpha blending with each splat's density integrated over the sub-pixel, which approaches
    `AlphaRenderer` with increasing `supersampling`.
    """

    name = "points"
    method = "points"
    capabilities = Capabilities(
        outputs=STANDARD_OUTPUTS,
        precisions={"cpu": ("fp32",), "cuda": ("fp32",)},
        differentiable=False,
        deterministic=True,
        options=("samples", "supersampling", "seed", "progressive", "storage"),
    )
