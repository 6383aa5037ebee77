"""The reconstructor learns a moving scene, the same way every time, and publishes it."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from gsplat_core.deformation import FIELDS, BasisField, HexPlaneField
from gsplat_core.io.recordings.synthetic.scene import SyntheticScene
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from gsplat_core.training.config import LearningRates, ReconstructorConfig
from gsplat_core.training.metrics import psnr_tissue_db
from gsplat_core.training.reconstructor import Reconstructor, validation_psnr_db

CONFIG = ReconstructorConfig(
    gaussians=400,
    max_gaussians=800,
    first_frame_steps=20,
    steps_per_frame=6,
)
EACH_FIELD = pytest.mark.parametrize("field", ["basis", "hexplane"])


def psnr_db(model, frame):
    image = model.render(frame.time_s, model.camera if frame.pose is None else model.camera.with_pose(frame.pose)).image
    target = torch.from_numpy(frame.image).float() / 255
    return psnr_tissue_db(image.clamp(0, 1), target, None if frame.mask is None else torch.from_numpy(frame.mask))


def learn(frames, camera, config=CONFIG, seed=0, device="cpu"):
    learning = Reconstructor(config, camera, seed=seed, device=device)
    for frame in frames:
        learning.observe(frame)
    return learning


@pytest.fixture
def small_hexplane(monkeypatch):
    """HexPlane fields of a size that suits the tiny frames: the full one takes a tenth of a second per step."""

    def small(wanted):
        sizes = {"channels": 8, "resolution": (12, 12, 4, 10), "levels": (1,), "width": 16, "depth": 1}
        return HexPlaneField(wanted.gaussians, wanted.time_window_s, **sizes)

    monkeypatch.setitem(FIELDS._entries, "hexplane", dataclasses.replace(FIELDS["hexplane"], new=small))


@pytest.fixture
def with_threads():
    """Sets torch's threads, and puts them back after the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@EACH_FIELD
def test_online_training_follows_moving_scene(small_hexplane, tissue_video, camera, field, device):
    frames = tissue_video(17)
    learning = Reconstructor(dataclasses.replace(CONFIG, field=field), camera, device=device)
    live = []
    for frame in frames:
        report = learning.observe(frame)
        live.append(psnr_db(learning.snapshot(), frame))
    assert (report.seq, report.steps, report.gaussians) == (16, 6, learning.gaussians)
    assert 0 < report.loss < 0.1
    still = Reconstructor(CONFIG, camera, device=device)
    still.observe(frames[0])
    untrained = psnr_db(still.snapshot(), frames[-1])  # 4 px away by now
    assert np.mean(live[4:]) > untrained + 10
    assert min(live) > 21


@pytest.mark.slow
@EACH_FIELD
def test_offline_fit_beats_static_model(small_hexplane, tissue_video, camera, field, device):
    frames = tissue_video(9, amplitude_px=6)
    config = dataclasses.replace(CONFIG, field=field)
    done = []
    learning = Reconstructor(config, camera, device=device)
    report = learning.fit(frames, 200, progress=lambda step, loss: done.append((step, loss)))
    assert [step for step, _ in done] == list(range(1, 201))
    assert (report.seq, report.steps, report.loss) == (8, 200, done[-1][1])
    model = learning.snapshot()
    assert model.time_window_s == (0.0, frames[-1].time_s)

    rates = FIELDS[field].rates
    no_motion = LearningRates(field=dataclasses.replace(rates, **dict.fromkeys(vars(rates), 0.0)))
    static = Reconstructor(dataclasses.replace(config, rates=no_motion), camera, device=device)
    static.fit(frames, 200)
    mean = lambda fitted: np.mean([psnr_db(fitted, frame) for frame in frames])
    assert mean(model) > mean(static.snapshot()) + 2.5


def test_online_training_follows_moving_camera(device):
    scene = SyntheticScene.from_seed(0, 48, 40, 2.0, moving=True)
    frames = []
    for seq in range(10):
        eye = scene.render(seq / 5)
        mask = np.where(eye.tool, 0, 1).astype(np.uint8)
        frames.append(
            Frame(
                seq,
                seq * 200_000_000,
                eye.image,
                depth=eye.depth,
                mask=mask,
                pose=scene.camera_at(seq / 5).world_to_camera,
            )
        )
    learning = Reconstructor(CONFIG, scene.camera, device=device)
    live = []
    for frame in frames:
        learning.observe(frame)
        live.append(psnr_db(learning.snapshot(), frame))
    model = learning.snapshot()
    assert min(live) > 24
    astray = psnr_db(model, frames[-1].with_fields(pose=frames[0].pose))
    assert live[-1] > astray + 1
    depth = model.render(frames[-1].time_s, scene.camera.with_pose(frames[-1].pose)).depth.cpu().numpy()
    tissue = frames[-1].mask > 0
    assert np.abs(depth - frames[-1].depth)[tissue].mean() < 4


@EACH_FIELD
def test_training_depends_only_on_seed(tissue_video, camera, field, with_threads, small_hexplane):
    config = dataclasses.replace(CONFIG, field=field, first_frame_steps=3, steps_per_frame=3, ssim_weight=0.2)
    frames = tissue_video(4)
    digests = []
    for threads, global_seed, seed in ((1, 1, 0), (2, 2, 0), (3, 3, 0), (1, 1, 1)):
        if field == "basis":  # torch's matrix products, in the HexPlane's network, are split among threads
            with_threads(threads)
        torch.manual_seed(global_seed)
        digests.append(learn(frames, camera, config, seed).snapshot().sha256())
    assert digests[0] == digests[1] == digests[2]
    assert digests[3] != digests[0]


def test_new_field_keeps_global_random_state(make_frame, camera):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    learn([make_frame()], camera, dataclasses.replace(CONFIG, field="hexplane", first_frame_steps=1))
    assert torch.equal(torch.rand(3), expected)


def test_offline_fit_is_deterministic(tissue_video, camera, device):
    def digest(seed):
        learning = Reconstructor(CONFIG, camera, seed=seed, device=device)
        learning.fit(tissue_video(4), 10)
        return learning.snapshot().sha256()

    assert digest(0) == digest(0)
    assert digest(0) != digest(1)


@EACH_FIELD
def test_heldout_frame_does_not_change_training(tissue_video, camera, field, small_hexplane, device):
    frames = tissue_video(4)
    config = dataclasses.replace(CONFIG, field=field, first_frame_steps=5)
    learning = learn(frames[:2], camera, config, device=device)
    before = learning.snapshot()
    # Its picture is a lie and half the frame is not covered: nothing of it may be seen.
    held = frames[2].with_fields(image=255 - frames[2].image)
    report = learning.observe(held, train=False)
    assert (report.steps, report.loss) == (0, None)
    after = learning.snapshot()
    for name, tensor in before.gaussians.tensors().items():
        assert torch.equal(tensor, after.gaussians.tensors()[name])
    assert after.time_window_s[1] == held.time_s
    learning.observe(frames[3])
    other = learn(frames[:2], camera, config, device=device)
    other.observe(frames[2], train=False)
    other.observe(frames[3])
    assert learning.snapshot().sha256() == other.snapshot().sha256()


def test_snapshots_have_increasing_versions_and_are_immutable(tissue_video, camera, device):
    frames = tissue_video(6)
    learning = Reconstructor(CONFIG, camera, recording_digest="ab" * 32, device=device)
    published = []
    for frame in frames:
        learning.observe(frame)
        model = learning.snapshot()
        published.append((model, model.sha256(), model.render(frame.time_s).image.clone()))
    assert [model.version for model, _, _ in published] == [1, 2, 3, 4, 5, 6]
    for frame, (model, digest, image) in zip(frames, published, strict=True):
        assert model.training_digest == "ab" * 32
        assert model.time_window_s == (0.0, frame.time_s)
        assert model.sha256() == digest
        assert torch.equal(model.render(frame.time_s).image, image)
    assert len({digest for _, digest, _ in published}) == 6


@pytest.mark.slow
@EACH_FIELD
def test_online_training_adds_gaussians_for_new_tissue(make_frame, camera, field, device):
    config = dataclasses.replace(CONFIG, field=field, first_frame_steps=4, max_gaussians=450)
    learning = Reconstructor(config, camera, device=device)
    learning.observe(make_frame(0))
    start = learning.gaussians
    for seq in range(1, 5):
        pose = np.eye(4)
        pose[0, 3] = -7.0 * seq  # to the right, by 6 px each
        report = learning.observe(make_frame(seq, shift_px=-5.8 * seq, pose=pose))
    assert start < learning.gaussians <= 450
    model = learning.snapshot()
    assert report.gaussians == model.gaussians.count == learning.gaussians
    assert type(model.field) is (BasisField if field == "basis" else HexPlaneField)


@pytest.mark.slow
@pytest.mark.parametrize("window_frames", [1, 30])
def test_tissue_behind_tool_keeps_last_seen_position(tissue_video, make_frame, camera, window_frames, device):
    frames = tissue_video(9)  # 2 px to the right in 0.4 s
    learning = learn(frames, camera, dataclasses.replace(CONFIG, window_frames=window_frames), device=device)
    last_s = frames[-1].time_s
    mask = np.ones((40, 48), np.uint8)
    mask[:, 24:] = 0
    for seq in range(9, 29):  # one more second, of which the right half shows nothing
        learning.observe(make_frame(seq, shift_px=2, mask=mask))
    model = learning.snapshot()
    seen = model.at(last_s)
    hidden = seen.means[:, 0] / seen.means[:, 2] * 50 + 24 > 32
    assert int(hidden.sum()) > 80
    in_px = lambda a, b: (a.means - b.means)[hidden][:, :2].norm(dim=1) * 50 / 60
    assert float(in_px(seen, model.at(0.0)).median()) > 1.2  # it has moved, so that staying is not trivial
    # Adam's momentum carries it on a little; to fall back to its canonical place would be 1.5 px and more.
    stayed = in_px(model.at(last_s + 1), seen)
    assert float(stayed.median()) < 1.0
    assert float(stayed.quantile(0.9)) < 1.8


@EACH_FIELD
def test_non_finite_depth_does_not_harm_training(tissue_video, camera, field, device):
    depth = np.full((40, 48), 60.0, np.float32)
    depth[::3] = np.nan
    depth[::5] = np.inf
    depth[:, ::7] = -np.inf
    config = dataclasses.replace(CONFIG, field=field, depth_weight=1.0)
    frames = tissue_video(3, depth=depth)
    model = learn(frames, camera, config, device=device).snapshot()
    assert all(bool(tensor.isfinite().all()) for tensor in model.tensors().values())
    assert psnr_db(model, frames[-1]) > 20


def test_observe_with_zero_steps_changes_no_gaussian(make_frame, camera, device):
    learning = Reconstructor(dataclasses.replace(CONFIG, first_frame_steps=2), camera, device=device)
    learning.observe(make_frame(0))
    means = learning.snapshot().gaussians.means
    report = learning.observe(make_frame(1, shift_px=3), steps=0)
    assert (report.steps, report.loss) == (0, None)
    assert torch.equal(learning.snapshot().gaussians.means, means)


def test_model_camera_is_camera_of_first_frame(make_frame, camera):
    pose = np.eye(4)
    pose[:3, 3] = [3, -2, 500]
    learning = learn([make_frame(pose=pose)], camera, dataclasses.replace(CONFIG, first_frame_steps=5))
    model = learning.snapshot()
    assert model.camera == camera.with_pose(pose)
    assert psnr_db(model, make_frame()) > 20
    # A rate in pixels is one in millimetres where the tissue is, not where the world's origin is.
    start = Reconstructor(CONFIG, camera)
    start.observe(make_frame(pose=pose), steps=0)
    moved = (model.gaussians.means - start.snapshot().gaussians.means).norm(dim=1)
    assert float(moved.median()) < 5 * 0.05 * 60 / 50


def test_single_frame_trains_online_and_offline(make_frame, device):
    small = Camera.from_focal(8.0, 5, 3)
    frame = make_frame(width=5, height=3)
    config = ReconstructorConfig(gaussians=6, first_frame_steps=2)
    for field in ("basis", "hexplane"):
        learning = Reconstructor(dataclasses.replace(config, field=field), small, device=device)
        learning.fit([frame], 2)
        learning.observe(frame)
        assert bool(learning.snapshot().render(0.0).image.isfinite().all())


def test_begin_scene_resets_loss_used_for_jump_detection():
    """A frame whose loss jumps gets four times its steps in addition; the frames of another scene get none."""
    flat = np.full((40, 48, 3), 120, np.uint8)
    noise = np.random.default_rng(0).integers(0, 256, (40, 48, 3), np.uint8)
    camera = Camera.from_focal(50.0, 48, 40)

    def steps(new_scene):
        learning = Reconstructor(dataclasses.replace(CONFIG, first_frame_steps=2, steps_per_frame=2), camera)
        for seq in range(4):
            learning.observe(Frame(seq, seq * 10**8, flat))
        if new_scene:
            learning.begin_scene(Frame(4, 4 * 10**8, noise))
        return [learning.observe(Frame(seq, seq * 10**8, noise)).steps for seq in (4, 5)]

    assert steps(new_scene=False)[0] == 10
    assert steps(new_scene=True) == [2, 2]


def test_stereo_depth_weight_is_larger_offline(monkeypatch, make_frame, camera):
    """The weights of a scene depend on this. Stereo depth counts ten times as much offline as online."""
    weights = []
    usual = ReconstructorConfig.starting_from

    def starting_from(config, frame, all_known):
        chosen = usual(config, frame, all_known)
        weights.append(chosen.depth_weight / config.depth_weight)
        return chosen

    monkeypatch.setattr(ReconstructorConfig, "starting_from", starting_from)
    plane = np.full((40, 48), 60.0, np.float32)
    frame = make_frame(depth=plane, depth_confidence=np.ones_like(plane), depth_origin=DEPTH_ORIGINS["stereo"])
    config = dataclasses.replace(CONFIG, gaussians=40, first_frame_steps=1)
    Reconstructor(config, camera).fit([frame], 1)
    Reconstructor(config, camera).observe(frame)
    assert weights == pytest.approx([10, 1])


def test_queued_steps_are_settled_before_scene_is_read_or_left(make_frame, camera, monkeypatch):
    """Queued steps may have to be repeated on a GPU."""
    learning = learn([make_frame(0)], camera)
    step, settled = learning._step, []
    monkeypatch.setattr(learning._schedule, "settle", settled.append)
    calls = [
        learning.snapshot, lambda: learning.picture(make_frame(0)), lambda: learning.take_depth(make_frame(0)),
        lambda: learning.observe(make_frame(1), train=False), lambda: learning.begin_scene(make_frame(2)),
    ]  # fmt: skip
    for count, call in enumerate(calls, 1):
        call()
        assert settled == [step] * count


@pytest.mark.parametrize("excluded", ["mask", "loss_mask"])
def test_validation_psnr_excludes_masked_pixels(excluded):
    """The picture is off by 10 levels where the frame counts, and by 200 elsewhere. A frame without such pixels has no score."""
    image = np.full((8, 12, 3), 40, np.uint8)
    kept = np.zeros((8, 12), np.uint8)
    kept[:, :6] = 1
    picture = np.repeat(np.where(kept[..., None], 50, 240), 3, 2).astype(np.uint8)
    learned = SimpleNamespace(picture=lambda frame: picture)
    frames = [Frame(0, 0, image, **{excluded: kept}), Frame(1, 1, image, **{excluded: 0 * kept})]
    assert validation_psnr_db(learned, frames) == pytest.approx(20 * np.log10(255 / 10), abs=1e-6)
    assert validation_psnr_db(learned, frames[1:]) == 0
