"""Places that were left are found again: those that the stream shows, and no others."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.initialisation import gaussians_from_frame
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from gsplat_core.training.upkeep import LEAST_SHARE, MOST_PLACES, LeftScenes, Places, Structure, structure_of

WIDTH, HEIGHT = 64, 48
CAMERA = Camera.from_focal(60.0, WIDTH, HEIGHT)


def tissue(seed, width=WIDTH, height=HEIGHT, shift_px=0.0):
    """A smooth random texture; the same seed is the same tissue."""
    random = np.random.default_rng(seed)
    coarse = random.uniform(40, 215, (9, 12, 3)).astype(np.float32)
    large = cv2.resize(coarse, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC)
    moved = cv2.warpAffine(large, np.float32([[1, 0, -shift_px], [0, 1, 0]]), (2 * WIDTH, 2 * HEIGHT))
    cut = moved[HEIGHT // 2 : HEIGHT // 2 + HEIGHT, WIDTH // 2 : WIDTH // 2 + WIDTH]
    return np.clip(np.rint(cv2.resize(cut, (width, height))), 0, 255).astype(np.uint8)


def frame_of(seed, seq=0, **fields):
    return Frame(seq, seq * 33_333_333, tissue(seed), **fields)


def left(*seeds):
    places = Places()
    for seed in seeds:
        gaussians = gaussians_from_frame(frame_of(seed), CAMERA, 400, sh_degree=0, default_depth_mm=60.0)
        places.leave(gaussians, CAMERA, float(seed))
    return places


def test_places_take_returns_and_removes_matching_place():
    places = left(1, 2, 3)
    assert places.take(frame_of(2)).left_s == 2.0
    assert len(places) == 2 and places.take(frame_of(2)) is None
    assert places.take(frame_of(9)) is None and len(places) == 2


@pytest.mark.parametrize("gain,offset", [(0.5, 0), (1.3, 0), (0.6, 40)])
def test_places_take_is_independent_of_exposure_and_white_balance(gain, offset):
    image = tissue(2) * np.array([gain, 0.9 * gain, 1.1 * gain]) + offset
    frame = Frame(0, 0, np.clip(image, 0, 255).astype(np.uint8))
    assert left(1, 2, 3).take(frame).left_s == 2.0


def test_places_take_compares_only_tissue():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, :30] = 0
    image = tissue(2)
    image[:, :30] = 255 * (np.indices((HEIGHT, 30)).sum(0) // 8 % 2)[..., None]
    assert left(2).take(Frame(0, 0, image)) is None
    assert left(2).take(Frame(0, 0, image, mask=mask)).left_s == 2.0
    assert left(2).take(Frame(0, 0, image, loss_mask=mask)).left_s == 2.0
    assert left(2).take(Frame(0, 0, tissue(2), mask=np.zeros_like(mask))) is None


def test_places_take_accepts_picture_of_other_size():
    assert left(1, 2).take(Frame(0, 0, tissue(2, 96, 72))).left_s == 2.0


def test_places_compare_last_picture_without_pose():
    """Without a pose no scene is rendered: the picture decides, whatever the Gaussians are."""
    gaussians = gaussians_from_frame(frame_of(1), CAMERA, 400, sh_degree=0, default_depth_mm=60.0)
    places = Places()
    places.leave(gaussians, CAMERA, 1.0, structure_of(frame_of(2)))
    assert places.take(frame_of(1)) is None
    assert places.take(frame_of(2)) is not None
    hidden = frame_of(2, mask=np.zeros((HEIGHT, WIDTH), np.uint8))
    assert structure_of(hidden) is None


@pytest.mark.parametrize("given", [True, False])
def test_left_scenes_use_last_frame_or_rendered_picture(given):
    gaussians = gaussians_from_frame(frame_of(1), CAMERA, 400, sh_degree=0, default_depth_mm=60.0)
    step = SimpleNamespace(at=lambda time_s: gaussians)
    scenes = LeftScenes()
    scenes.leave(step, CAMERA, 1.0, frame_of(2) if given else None)
    assert not scenes.recognise(frame_of(1 if given else 2))
    assert scenes.recognise(frame_of(2 if given else 1))


@pytest.mark.parametrize("share", [0.28, 0.32])
def test_structure_of_is_none_for_little_tissue(share):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, : round(share * WIDTH)] = 1
    assert (structure_of(frame_of(2, mask=mask)) is not None) == (share > LEAST_SHARE)


def test_places_leave_copies_gaussians():
    gaussians = gaussians_from_frame(frame_of(1), CAMERA, 400, sh_degree=0, default_depth_mm=60.0)
    before, places = gaussians.means.clone(), Places()
    places.leave(gaussians, CAMERA, 1.0)
    gaussians.means.add_(1)
    assert torch.equal(places._left[0].gaussians.means, before)


def test_rehearsal_moves_places_to_host(monkeypatch):
    moved = []
    monkeypatch.setattr(Places, "to_host", lambda places: moved.append(places))
    made = Reconstructor(ReconstructorConfig(gaussians=60, max_gaussians=60), CAMERA, live=LiveTraining())
    made.observe(frame_of(1), budget=Budget.of_steps(1))
    assert not moved
    made.rehearse(1)
    assert moved


@pytest.mark.cuda
def test_newest_place_stays_on_cuda_until_to_host(gpu):
    gaussians = gaussians_from_frame(frame_of(1), CAMERA, 400, sh_degree=0, default_depth_mm=60.0)
    places = Places()
    for time_s in (1.0, 2.0):
        places.leave(gaussians.to(gpu), CAMERA, time_s)
    assert [place.gaussians.means.device.type for place in places._left] == ["cpu", "cuda"]
    found = places.take(frame_of(1))
    assert found is not None and torch.equal(found.gaussians.means.cpu(), gaussians.means)
    places.to_host()
    assert [place.gaussians.means.device.type for place in places._left] == ["cpu"]


def test_places_take_is_none_for_pose_looking_elsewhere():
    away = np.eye(4)
    away[0, 3] = -30.0
    assert left(2).take(frame_of(2, pose=np.eye(4))) is not None
    assert left(2).take(frame_of(2, pose=away)) is None


@pytest.mark.parametrize("image", [np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH, 3), 255), tissue(2)[:, ::-1]])
def test_places_take_is_none_for_black_white_or_mirrored_picture(image):
    assert left(1, 2, 3).take(Frame(0, 0, np.ascontiguousarray(image, np.uint8))) is None


def _structure(image, known=None):
    known = np.ones(image.shape[:2], bool) if known is None else known
    return Structure.of(np.asarray(image, np.float32) / 255, known)


def mixed(likeness):
    """A picture of place 2 and of other tissue, mixed until it is as like the place as that."""
    places = left(2)
    low, high = 0.0, 1.0
    for _ in range(30):
        share = (low + high) / 2
        image = np.rint(share * tissue(2) + (1 - share) * tissue(9)).astype(np.uint8)
        if places._left[0].structure(CAMERA).likeness(_structure(image)) < likeness:
            low = share
        else:
            high = share
    return Frame(0, 0, image)


@pytest.mark.parametrize(
    ("likeness", "is_found"), [(0.3, False), (0.6, False), (0.7, False), (0.79, True), (0.9, True)]
)
def test_places_take_requires_likeness_of_0_75(likeness, is_found):
    """Different places reach 0.6; a place that is kept in view stays above 0.75."""
    places, frame = left(1, 2, 3), mixed(likeness)
    assert (places.take(frame) is not None) == is_found
    assert len(places) == 3 - is_found


def test_number_of_places_is_limited():
    places = left(*range(MOST_PLACES + 3))
    assert len(places) == MOST_PLACES
    assert places.take(frame_of(0)) is None and places.take(frame_of(5)) is not None


def test_likeness_is_zero_without_known_pixels_or_structure():
    known = np.zeros((HEIGHT, WIDTH), bool)
    whole, unknown = _structure(tissue(1)), _structure(tissue(1), known)
    assert whole.likeness(unknown) == unknown.likeness(whole) == 0.0
    assert whole.likeness(whole) == pytest.approx(1.0)
    grey = _structure(np.full_like(tissue(1), 90))
    assert whole.likeness(grey) == pytest.approx(0.0, abs=1e-3), "a picture without structure is like none"


def test_structure_ignores_unknown_pixels():
    """The structure of the known part is that of the picture without the other part, up to the blur across the border."""
    known = np.ones((HEIGHT, WIDTH), bool)
    known[:, 40:] = False
    picture, changed = tissue(1), tissue(1)
    changed[:, 40:] = tissue(5)[:, 40:]
    np.testing.assert_array_equal(_structure(picture, known).values, _structure(changed, known).values)
    assert _structure(changed, known).likeness(_structure(picture)) > 0.97


def test_likeness_is_mean_over_channels():
    """A channel that is inverted correlates with -1."""
    inverted = tissue(1).copy()
    inverted[..., 0] = 255 - inverted[..., 0]
    assert _structure(tissue(1)).likeness(_structure(inverted)) == pytest.approx(1 / 3, abs=0.01)


def reconstructor(device="cpu"):
    config = ReconstructorConfig(
        gaussians=500, max_gaussians=1000, window_frames=20, motion_spacing_s=0.1, history_s=1.0, preallocate=True
    )
    # Rates for a few steps a frame: those of a live run are made for dozens.
    return Reconstructor(config, CAMERA, live=LiveTraining(first_rate=1.0, last_rate=1.0), device=device)


def watch(made, frames, steps):
    for frame in frames:
        if frame.new_scene is not None:
            made.begin_scene(frame)
        made.observe(frame, budget=Budget.of_steps(steps))


def score(made, frame):
    image = made.snapshot().render(frame.time_s).image
    return psnr_tissue_db((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy(), frame.image, frame.mask)


def swinging(seed, first, count, new_scene=None):
    for seq in range(first, first + count):
        image = tissue(seed, shift_px=1.5 * np.sin(seq / 5))
        yield Frame(seq, seq * 33_333_333, image, new_scene=new_scene if seq == first else None)


@pytest.mark.slow
def test_returning_scope_resumes_left_scene(device):
    made = reconstructor(device)
    watch(made, swinging(1, 0, 60), steps=8)
    memory = [tensor.data_ptr() for tensor in made._step.field.training_tensors()]
    watch(made, swinging(2, 60, 20, new_scene="cut"), steps=4)
    back = list(swinging(1, 60 + 1800, 3))
    # A tool covers half of the picture when it is back: what lies there was seen before.
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, WIDTH // 2 :] = 0
    assert made.begin_scene(back[0].with_fields(mask=mask))
    watch(made, (frame.with_fields(mask=mask) for frame in back), steps=8)
    assert score(made, back[-1].with_fields(mask=mask)) > 33
    # The hidden half swung on, but it is that tissue: without memory it is painted over from the other half.
    hidden = back[-1].with_fields(mask=1 - mask)
    fresh = reconstructor(device)
    watch(fresh, (frame.with_fields(mask=mask) for frame in back), steps=8)
    assert score(made, hidden) > score(fresh, hidden) + 5
    assert made._step.field.time_window_s[0] == pytest.approx(back[0].time_s)
    assert [tensor.data_ptr() for tensor in made._step.field.training_tensors()] == memory


def test_begin_scene_of_unseen_place_starts_new_scene(device):
    made = reconstructor(device)
    watch(made, swinging(1, 0, 5), steps=4)
    other = next(iter(swinging(2, 5, 1)))
    assert not made.begin_scene(other)
    made.observe(other, budget=Budget.of_steps(30))
    assert score(made, other) > 30
    assert made.kept()["places"] == 1
    assert made.snapshot().version > 0


def test_recognised_scene_of_other_size_uses_new_memory():
    made = reconstructor()
    watch(made, swinging(1, 0, 20), steps=6)
    large = Frame(20, 20 * 33_333_333, tissue(1, 96, 72, shift_px=1.5 * np.sin(4)), new_scene="resized")
    assert made.begin_scene(large)
    made.observe(large, budget=Budget.of_steps(20))
    assert (made.camera.width_px, made.camera.height_px) == (96, 72)
    assert score(made, large) > 30


def test_forget_removes_places():
    made = reconstructor()
    watch(made, swinging(1, 0, 3), steps=2)
    made.begin_scene(next(iter(swinging(2, 3, 1))))
    made.forget()
    assert made.kept()["places"] == 0


@pytest.mark.cuda
def test_cut_reuses_captured_cuda_graph(gpu):
    made = reconstructor(gpu)
    watch(made, swinging(1, 0, 10), steps=6)
    graph = made._step._captured._captured
    watch(made, swinging(2, 10, 10, new_scene="cut"), steps=6)
    watch(made, swinging(1, 20, 10, new_scene="cut"), steps=6)
    assert made._step._captured._captured is graph


@pytest.mark.parametrize(("share", "is_known"), [(0.25, False), (0.35, True)])
def test_likeness_requires_three_tenths_of_pixels_known(share, is_known):
    known = np.zeros((HEIGHT, WIDTH), bool)
    known[:, : round(share * WIDTH)] = True
    assert (_structure(tissue(1), known).likeness(_structure(tissue(1), known)) > 0.99) == is_known


def test_at_most_eight_places_are_kept():
    assert len(left(*range(7))) == 7 and len(left(*range(8))) == len(left(*range(9))) == 8


@pytest.mark.parametrize(("samples", "is_known"), [(7, False), (8, True), (9, True)])
def test_structure_pixel_is_known_if_half_of_samples_are(samples, is_known):
    mask = np.ones((4 * HEIGHT, 4 * WIDTH), np.uint8)
    block = np.zeros(16, np.uint8)  # the samples of one compared pixel
    block[:samples] = 1
    mask[4:8, 8:12] = block.reshape(4, 4)
    frame = Frame(0, 0, tissue(1, 4 * WIDTH, 4 * HEIGHT), mask=mask)
    known = structure_of(frame).known
    assert known[1, 2] == is_known and known.sum() == known.size - (not is_known)
