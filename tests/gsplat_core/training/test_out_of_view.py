"""A scope that wanders with known poses: what it left makes room, and is there again when it is back."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from gsplat_core.scene.gaussians import Gaussians, RowMoves
from gsplat_core.training import covering
from gsplat_core.training.config import ReconstructorConfig
from gsplat_core.training.covering import Archive, LastSeen, OutOfView
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.observations import Observation, pixels_of
from gsplat_core.training.reconstructor import Reconstructor
from gsplat_core.training.schedule import Budget, LiveTraining
from operators.display import share_of

WIDTH, HEIGHT = 48, 40
FOCAL = 50.0
DEPTH_MM = 60.0
CAMERA = Camera.from_focal(FOCAL, WIDTH, HEIGHT)
WALL = cv2.resize(
    np.random.default_rng(3).uniform(40, 215, (8, 60, 3)).astype(np.float32),
    (480, HEIGHT),
    interpolation=cv2.INTER_CUBIC,
)


def frame_at(seq, column, time_s=None, **fields):
    """The wall seen from where its `column` is at the left edge of the picture."""
    image = np.clip(np.rint(WALL[:, column : column + WIDTH]), 0, 255).astype(np.uint8)
    pose = np.eye(4)
    pose[0, 3] = -column * DEPTH_MM / FOCAL
    time_s = seq / 30 if time_s is None else time_s
    return Frame(seq, round(time_s * 1e9), image, pose=pose, **fields)


def reconstructor(rows, device="cpu"):
    config = ReconstructorConfig(
        gaussians=300, max_gaussians=rows, window_frames=20, motion_spacing_s=0.1, history_s=1.0, preallocate=True,
        default_depth_mm=DEPTH_MM,
    )  # fmt: skip
    # Rates for a few steps a frame: those of a live run are made for dozens.
    return Reconstructor(config, CAMERA, live=LiveTraining(first_rate=1.0, last_rate=1.0), device=device)


def watch(made, frames, steps=6):
    for frame in frames:
        made.observe(frame, budget=Budget.of_steps(steps))
        made.grow(frame)
        made.rehearse(2)


def score(made, frame):
    image = made.snapshot().render(frame.time_s, CAMERA.with_pose(frame.pose)).image
    return psnr_tissue_db((image.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy(), frame.image)


def wandering_frames(first, columns):
    return [frame_at(first + k, column) for k, column in enumerate(columns)]


@pytest.mark.slow
@pytest.mark.parametrize("rows", [6000, 700])
def test_returning_scope_finds_scene_after_a_minute(device, rows):
    """Cover capacity for the whole scene, and capacity for two pictures, where most of the scene is archived."""
    made = reconstructor(rows, device)
    watch(made, wandering_frames(0, [0] * 30), steps=8)
    watch(made, wandering_frames(30, range(0, 380, 4)))
    at = frame_at(125, 376)
    watch(made, [at.with_fields(seq=125 + k, pts_ns=at.pts_ns + k * 3 * 10**9) for k in range(20)], steps=2)
    assert (made.kept()["archived"] > 200) == (rows == 700)
    assert made.gaussians <= rows
    back = [frame_at(200 + k, 0, time_s=70 + k / 30) for k in range(3)]
    shown = []
    for frame in back:
        watch(made, [frame], steps=20)
        shown.append(score(made, frame))
    assert max(shown) > 33
    fresh = reconstructor(rows, device)
    watch(fresh, back, steps=20)
    assert made.gaussians <= rows and shown[-1] > score(fresh, back[-1])


@pytest.mark.slow
def test_tissue_out_of_view_is_remembered_without_training():
    made = reconstructor(6000)
    watch(made, wandering_frames(0, [0] * 30), steps=8)
    watch(made, wandering_frames(30, range(0, 200, 4)))
    assert score(made, frame_at(100, 0, time_s=made.snapshot().time_window_s[1])) > 24


@pytest.mark.slow
def test_gaussians_behind_tool_are_never_archived():
    made = reconstructor(310)  # fewer free rows than are kept free
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, 24:] = 0
    watch(made, [frame_at(0, 0)])
    watch(made, [frame_at(k, 0, mask=mask) for k in range(1, 60)], steps=1)
    assert made.kept()["archived"] == 0


def moved(count, **at):
    means = torch.zeros(count, 3)
    means[:, 2] = DEPTH_MM
    for row, x in at.items():
        means[int(row[1:]), 0] = x
    one = torch.ones(count, 4)
    return Gaussians(means, one, one[:, :3], one[:, 0], torch.zeros(count, 1, 3))


def test_last_seen_counts_only_visible_tissue():
    seen = LastSeen(6, torch.device("cpu"))
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, 30:] = 0
    first = Observation.of(frame_at(0, 0, time_s=1.0), CAMERA)
    later = Observation.of(frame_at(1, 0, time_s=5.0, mask=mask), CAMERA)
    scene = moved(4, r1=20.0, r2=100.0)  # in the middle, under the tool, out of view
    scene.means[3, 2] = -DEPTH_MM  # behind the camera
    seen.see(scene, first)
    seen.see(scene, later)
    assert seen.times().tolist() == [5.0, 1.0, 1.0, 1.0]
    anyone = torch.ones(4, dtype=torch.bool)
    assert seen.longest_unseen(3, 3.0, anyone).tolist() == [False, True, True, True]
    assert seen.longest_unseen(2, 3.0, anyone).sum() == 2
    assert not seen.longest_unseen(3, 0.5, anyone).any()
    anyone[2] = False
    assert seen.longest_unseen(4, 3.0, anyone).tolist() == [False, True, False, True]
    seen.close_gaps(RowMoves.without(torch.tensor([True, False, False, False])))
    seen.join(4, 9.0)
    assert sorted(seen.times().tolist()) == [1.0, 1.0, 1.0, 9.0]


@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_pixels_of_equals_renderer_projection(model):
    from gsplat_core.ops.projection import fully_fused_projection

    camera = Camera(CAMERA.K if model != "ortho" else np.diag([0.8, 0.8, 1.0]) + np.array([[0, 0, 24.0], [0, 0, 20], [0, 0, 0]]),
                    WIDTH, HEIGHT, model=model)  # fmt: skip
    means = torch.randn(50, 3) * 10 + torch.tensor([0.0, 0.0, 60.0])
    viewmat, K = (matrix[None] for matrix in camera.matrices(means.device))
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(50, 1), torch.ones(50, 3)
    expected = fully_fused_projection(means, None, quats, scales, viewmat, K, WIDTH, HEIGHT, camera_model=model)
    visible = (expected[0][0] > 0).all(-1)
    pixels, _ = pixels_of(means, camera)
    torch.testing.assert_close(pixels[visible], expected[1][0][visible], rtol=1e-3, atol=1e-2)


def test_archive_is_bounded_and_counts_forgotten():
    archive = Archive(5)
    archive.put(moved(4, r0=1.0, r1=2.0, r2=3.0, r3=4.0))
    archive.put(moved(3, r0=5.0, r1=6.0, r2=7.0))
    assert len(archive) == 5 and archive.forgotten == 2
    assert bool(archive.in_view(CAMERA).all())
    covered = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    assert archive.take_uncovered(CAMERA, covered, 9) is None
    assert archive.take_uncovered(CAMERA, ~covered, 0) is None
    newest = archive.take_uncovered(CAMERA, ~covered, 2)
    assert newest.means[:, 0].tolist() == [6.0, 7.0] and len(archive) == 3
    assert archive.take_uncovered(CAMERA, ~covered, 9).means[:, 0].tolist() == [3.0, 4.0, 5.0]
    assert len(archive) == 0 and archive.take_uncovered(CAMERA, ~covered, 9) is None


@pytest.mark.slow
def test_published_model_has_unseen_times(device):
    """A published model counts tissue as seen at first and as remembered once the scope has left it."""
    made = reconstructor(2000, device)
    here, there = frame_at(0, 0), frame_at(60, WIDTH, time_s=2.0)

    def share(frame):
        model = made.publish().as_model()
        gaussians = model.at(model.time_window_s[1])
        return share_of(gaussians, model.unseen_s > 0, CAMERA.with_pose(frame.pose))

    watch(made, [frame_at(k, 0) for k in range(9)])
    first = made.publish().as_model()
    before = first.unseen_s.clone()
    assert share(here).median() < 0.01
    watch(made, [there.with_fields(seq=60 + k, pts_ns=there.pts_ns + k * 10**7) for k in range(9)])
    model = made.publish().as_model()
    assert model.unseen_s.shape == (model.gaussian_count,) and model.unseen_s.max() > 1.5
    assert share(here).median() > 0.99 and share(there).median() < 0.01
    assert torch.equal(first.unseen_s, before), "an earlier model stays as it was"


@pytest.mark.parametrize("capacity", [300, 30])
def test_visibility_is_tested_every_eighth_frame_or_each_without_capacity(capacity):
    """The scope moves on after the first frame."""
    out_of_view = OutOfView(capacity, torch.device("cpu"))
    scene = moved(30)
    step = SimpleNamespace(gaussians=scene, at=lambda time_s: scene)
    unseen = []
    for k in range(18):
        frame = frame_at(k, 0 if k == 0 else 8 * WIDTH, time_s=k / 100)
        out_of_view.follow(step, Observation.of(frame, CAMERA.with_pose(frame.pose)))
        unseen.append(out_of_view.unseen_s(30).max().item())
    expected = [8 * (k // 8) / 100 if capacity == 300 else k / 100 for k in range(18)]
    assert unseen == pytest.approx(expected, abs=1e-6)


def test_make_room_archives_gaussians_a_tenth_width_outside_picture(monkeypatch):
    """Only the requested number of Gaussians is archived, and only after the given time."""
    camera = Camera.from_focal(100.0, 100, 80)
    pixels = torch.tensor(
        [[50.0, 40.0], [-9.0, 40.0], [-11.0, 40.0], [109.0, 40.0], [111.0, 40.0], [50.0, -9.0], [50.0, 91.0]]
    )
    rays = torch.cat([(pixels - torch.tensor([50.0, 40.0])) / 100, torch.ones(7, 1)], 1)
    out, asked = OutOfView(10, torch.device("cpu")), []
    step = SimpleNamespace(gaussians=SimpleNamespace(count=7), at=lambda time_s: SimpleNamespace(means=50 * rays))
    monkeypatch.setattr(
        out.last_seen, "longest_unseen", lambda *given: asked.append(given) or torch.zeros(7, dtype=torch.bool)
    )
    seen = SimpleNamespace(camera=camera, time_s=3.0)
    out.make_room(step, seen, 3, 0.5)
    assert asked == [], "three rows are free"
    out.make_room(step, seen, 5, 0.5)
    ((short, before_s, outside),) = asked
    assert (short, before_s) == (2, 2.5)
    assert outside.tolist() == [False, False, True, False, True, False, True]


def test_bring_back_searches_archive_around_wanted_pixels(monkeypatch):
    out, searched = OutOfView(10, torch.device("cpu")), []
    seen = SimpleNamespace(camera=None)
    monkeypatch.setattr(out.archive, "take_uncovered", lambda camera, near, most: searched.append((near, most)))
    wanted = torch.zeros(20, 30, dtype=torch.bool)
    out.bring_back(None, seen, wanted)
    assert searched == []
    wanted[10, 12] = True
    out.bring_back(None, seen, wanted)
    ((near, most),) = searched
    expected = torch.zeros(20, 30, dtype=torch.bool)
    expected[5:16, 7:18] = True  # five pixels around
    assert most == 10 and torch.equal(near, expected)


class Scene:
    """Rows of a scene, without training."""

    def __init__(self, gaussians, alpha=0.0):
        self.gaussians, self.alpha, self.pictures = gaussians, alpha, []

    def at(self, time_s):
        return self.gaussians

    def remove(self, leaving):
        moves = RowMoves.without(leaving)
        self.gaussians = self.gaussians.select(moves.order)
        return moves

    def append(self, added):
        self.gaussians = self.gaussians.append(added)

    def picture(self, gaussians, camera, depth):
        self.pictures.append(camera)
        return SimpleNamespace(alpha=torch.full((HEIGHT, WIDTH), self.alpha))

    @property
    def columns(self):
        return sorted(self.gaussians.means[:, 0].tolist())


def seen_from(column, time_s):
    frame = frame_at(0, column, time_s=time_s)
    return Observation.of(frame, CAMERA.with_pose(frame.pose))


def wandered(capacity, count=20, alpha=0.0):
    """A scene of `count` Gaussians 0.5 apart, seen at 0 s and left at 1 s."""
    scene = moved(count)
    scene.means[:, 0] = torch.arange(count) * 0.5 - 5
    step, out = Scene(scene, alpha), OutOfView(capacity, torch.device("cpu"))
    out.follow(step, seen_from(0, 0.0))
    out.follow(step, seen_from(8 * WIDTH, 1.0))
    return step, out


@pytest.mark.parametrize(("capacity", "archived"), [(400, 0), (20, 2), (30, 0)])
def test_archive_keeps_a_tenth_of_capacity_free(capacity, archived):
    step, out = wandered(capacity)
    assert len(out.archive) == archived and step.gaussians.count == 20 - archived
    assert set(step.columns) <= {round(-5 + 0.5 * k, 3) for k in range(20)}


@pytest.mark.parametrize(("alpha", "is_back"), [(0.0, True), (1.0, False)])
def test_archived_gaussians_return_to_uncovered_pixels(alpha, is_back):
    step, out = wandered(20, alpha=alpha)
    all_columns = [round(-5 + 0.5 * k, 3) for k in range(20)]
    assert len(out.archive) == 2 and step.pictures == [], "no Gaussian of the archive is in that picture"
    step.gaussians = step.gaussians.select(slice(0, 12))  # capacity is there
    left = step.columns
    out.follow(step, seen_from(0, 1.1))
    assert len(step.pictures) == 1 and len(out.archive) == (0 if is_back else 2)
    assert len(step.columns) == 12 + 2 * is_back and set(left) <= set(step.columns)
    assert set(step.columns) <= set(all_columns)
    out.follow(step, seen_from(0, 1.2))
    assert len(step.pictures) == 1, "an archive is searched once for a camera"
    if is_back:
        assert out.last_seen.times().tolist() == pytest.approx([1.1] * 14)


def test_gaussians_without_room_stay_in_archive():
    step, out = wandered(20)
    out._capacity = 19
    out.follow(step, seen_from(0, 1.1))
    assert step.gaussians.count == 19 and len(out.archive) == 1
    out.restart()
    assert len(out.archive) == 0 and len(out.last_seen.times()) == 0


@pytest.mark.parametrize("room", [0, 3, 500])
def test_fill_new_tissue_is_limited_by_capacity(monkeypatch, room):
    """Gaussians are taken from the archive first, if there is one."""
    calls = []
    observation, frame = seen_from(0, 2.0), frame_at(0, 0, time_s=2.0)
    wanted = torch.arange(7)

    class New:
        is_any = True

        def __init__(self, *given):
            calls.append("new")

        def __bool__(self):
            return self.is_any

        def pixels(self, now):
            return "pixels"

        def unfilled(self, now, mask):
            return wanted, "depth"

    def beside(places, of, known_mm, seen, config, most):
        calls.append((known_mm, most))
        return moved(min(most, len(places))) if most else None

    out = SimpleNamespace(
        has_in_view=lambda camera: True,
        bring_back=lambda step, seen, pixels: calls.append(("back", pixels)),
        last_seen=SimpleNamespace(see=lambda now, seen: calls.append("seen")),
        make_room=lambda step, seen, count, unseen_s: calls.append(("room", count, unseen_s)),
    )
    monkeypatch.setattr(covering, "NewTissue", New)
    monkeypatch.setattr(covering, "gaussians_beside", beside)
    step = Scene(moved(10))
    step.distance = lambda camera: 60.0
    config = ReconstructorConfig(gaussians=10, max_gaussians=10 + room)
    arguments = step, frame, observation, observation.camera, config
    covering.fill_new_tissue(*arguments, out)
    assert calls == ["new", ("back", "pixels"), "seen", ("room", 7, 0.0), ("depth", room)]
    assert step.gaussians.count == 10 + min(room, 7)
    calls.clear()
    out.has_in_view, wanted = lambda camera: False, torch.zeros(0)
    depth = np.full((HEIGHT, WIDTH), 60.0, np.float32)
    covering.fill_new_tissue(step, frame.with_fields(depth=depth), *arguments[2:], out)
    (_, (known_mm, _)) = calls
    np.testing.assert_array_equal(known_mm, depth)
    calls.clear()
    New.is_any = False
    covering.fill_new_tissue(*arguments, None)
    assert calls == ["new"]
