"""Repeated colour corrections against plain torch in float64, and what they never do."""

from __future__ import annotations

import pytest
import torch

from gsplat_core import reference
from gsplat_core.errors import InvalidInput
from gsplat_core.ops.compositing import rasterize_to_pixels
from gsplat_core.ops.correct_colours import correct_colours
from tests.gsplat_core.ops.ray_scenes import RayScene, ray_scene, with_bad_values

OPTIONS = dict(relaxation=1.5, least_weight=0.3)


def target(scene: RayScene, tissue: float = 0.7, seed: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    image = torch.randint(0, 256, (scene.height, scene.width, 3), generator=random, dtype=torch.uint8)
    return image, (torch.rand(scene.height, scene.width, generator=random) < tissue).to(torch.uint8) * 255


def splats(scene: RayScene, seed: int = 5) -> list[torch.Tensor]:
    """Means, conics, colours with some below 0, opacities and lists of one picture."""
    random = torch.Generator().manual_seed(seed)
    colours = torch.rand(len(scene.means2d), 3, generator=random) * 1.4 - 0.3
    return [scene.means2d, scene.conics, colours, scene.opacities, *scene.lists()]


def exact(inputs: list[torch.Tensor], image: torch.Tensor, mask: torch.Tensor, **options: float) -> torch.Tensor:
    return reference.correct_colours(*(t.double() for t in inputs[:4]), *inputs[4:], image, mask, **options)


@pytest.mark.parametrize("steps", [0, 1, 5])
@pytest.mark.parametrize(("width", "height", "count"), [(37, 29, 60), (64, 48, 300), (1, 1, 5), (17, 3, 40), (5, 5, 0)])
def test_correct_colours_equals_reference(width, height, count, steps):
    scene = ray_scene(count, width, height)
    inputs, (image, mask) = splats(scene), target(scene)
    seen = correct_colours(*inputs, image, mask, steps=steps, **OPTIONS)
    wanted = exact(inputs, image, mask, steps=steps, **OPTIONS)
    torch.testing.assert_close(seen.double(), wanted, rtol=1e-3, atol=2e-4)
    assert count < 60 or steps == 0 or float((seen - inputs[2]).abs().max()) > 0.1


def test_correct_colours_with_opaque_splats_and_long_list():
    """More splats per tile than one pass over the blocks takes, with pixels that end before the last one."""
    scene = ray_scene(500, 32, 32)
    scene.opacities[::3] = 1.0
    inputs, (image, mask) = splats(scene), target(scene, tissue=1.0)
    assert inputs[5].numel() > 4 * 64
    seen = correct_colours(*inputs, image, mask, steps=3, max_alpha=0.999, **OPTIONS)
    wanted = exact(inputs, image, mask, steps=3, max_alpha=0.999, **OPTIONS)
    torch.testing.assert_close(seen.double(), wanted, rtol=1e-3, atol=2e-4)


def test_correct_colours_reduces_error_with_each_step():
    scene = ray_scene(200, 48, 40)
    inputs, (image, mask) = splats(scene), target(scene, tissue=1.0)

    def error(steps: int) -> float:
        colours = correct_colours(*inputs, image, mask, steps=steps, **OPTIONS)
        shown, _ = rasterize_to_pixels(
            *(t[None] for t in (inputs[0], inputs[1], colours.clamp(min=0), inputs[3])), 48, 40, 16, inputs[4][None],
            inputs[5],
        )  # fmt: skip
        return float((shown[0] - image.float() / 255).square().mean())

    errors = [error(steps) for steps in range(6)]
    assert errors == sorted(errors, reverse=True) and errors[5] < 0.9 * errors[0]


def test_correct_colours_unchanged_without_tissue_and_never_negative():
    scene = ray_scene(80)
    inputs, (image, mask) = splats(scene), target(scene)
    assert torch.equal(correct_colours(*inputs, image, mask * 0, steps=4, **OPTIONS), inputs[2])
    dark = correct_colours(*inputs, image * 0, mask, steps=4, **OPTIONS)
    assert bool((dark >= inputs[2].clamp(max=0) - 1e-6).all()) and bool((dark <= inputs[2] + 1e-6).all())


def test_correct_colours_leaves_non_finite_splats_unchanged():
    scene, _ = with_bad_values(ray_scene(100))
    inputs, (image, mask) = splats(scene), target(scene)
    inputs[2][7] = float("nan")
    usable = torch.cat([t.reshape(100, -1) for t in inputs[:4]], 1).isfinite().all(1)
    assert 0 < int(usable.sum()) < 99
    seen = correct_colours(*inputs, image, mask, steps=3, **OPTIONS)
    torch.testing.assert_close(seen[~usable], inputs[2][~usable], rtol=0, atol=0, equal_nan=True)
    positions = torch.cumsum(usable, 0) - 1
    offsets, ids = inputs[4], inputs[5].long()
    kept = usable[ids]
    counts = torch.cumsum(kept, 0)
    starts = torch.cat([torch.zeros(1, dtype=torch.long), counts])[offsets.long()]
    alone = [*(t[usable] for t in inputs[:4]), starts.int(), positions[ids[kept]].int()]
    wanted = correct_colours(*alone, image, mask, steps=3, **OPTIONS)
    torch.testing.assert_close(seen[usable], wanted, rtol=1e-4, atol=1e-5)


def test_correct_colours_independent_of_thread_count():
    scene = ray_scene(500, 90, 70)
    inputs, (image, mask) = splats(scene), target(scene)
    found, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            found.append(correct_colours(*inputs, image, mask, steps=3, **OPTIONS))
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(found[0], other) for other in found[1:])


def test_correct_colours_passes_opcheck():
    scene = ray_scene(8, 20, 10)
    image, mask = target(scene)
    op = torch.ops.gsplat_core.correct_colours
    torch.library.opcheck(op, (*splats(scene), image, mask, 2, 1.0, 0.3))


def test_correct_colours_rejects_invalid_arguments():
    scene = ray_scene(5, 20, 20)
    inputs, (image, mask) = splats(scene), target(scene)
    with pytest.raises(InvalidInput, match="do not cover"):
        correct_colours(*inputs, image.repeat(1, 3, 1), mask.repeat(1, 3), steps=1, **OPTIONS)
    with pytest.raises(InvalidInput, match=r"mask \[H, W\], got \[20, 20, 3\] and \[3, 20\]"):
        correct_colours(*inputs, image, mask[:3], steps=1, **OPTIONS)
    with pytest.raises(InvalidInput, match="must be uint8"):
        correct_colours(*inputs, image.float(), mask, steps=1, **OPTIONS)
    with pytest.raises(InvalidInput, match=r"colors must be \[N, 3\]"):
        correct_colours(*inputs[:2], inputs[2][:, :2], *inputs[3:], image, mask, steps=1, **OPTIONS)
    with pytest.raises(InvalidInput, match="steps is -1"):
        correct_colours(*inputs, image, mask, steps=-1, **OPTIONS)
    with pytest.raises(InvalidInput, match="max_alpha"):
        correct_colours(*inputs, image, mask, steps=1, max_alpha=1.0, **OPTIONS)
