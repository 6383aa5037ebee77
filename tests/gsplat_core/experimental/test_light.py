"""`LightDepth`: depth of a known surface is recovered, and no relief is invented from texture."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from gsplat_core.depth.maps import DEPTHS
from gsplat_core.experimental import light
from gsplat_core.experimental.light import FLAT, UNSEEN, Grid, LightDepth, Places
from gsplat_core.experimental.shading import SmallPicture, shading_in
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import DEPTH_ORIGINS, Frame
from tests.gsplat_core.geometry.lit_sheet import CAMERA, HEIGHT, PINK, WIDTH, error, facing_and_distance, rays


def lit(z):
    """Brightness of a Lambertian surface of depth z [H, W] in a lamp at the camera, from points and normals, 1 at distance 60."""
    facing, distance = facing_and_distance(z)
    return facing * (60 / distance) ** 2


def picture(z, colour=PINK, light=1.0):
    """The surface as a camera shows it, with the sRGB curve."""
    linear = np.clip(light * lit(z)[..., None] * colour, 0, 1)
    curve = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)


def bowl():
    """The surface is twice as far away on one side as on the other, with a hollow."""
    x, y = rays()
    return 60 * np.exp(0.5 * x + 0.2 * np.cos(4 * y) + 0.15 * np.cos(5 * x))


def plane():
    return np.full((HEIGHT, WIDTH), 60.0)


def depth_of(image, **fields):
    return LightDepth().estimate(Frame(0, 0, image, **fields), CAMERA)


def noise(seed, cell_px):
    grid = np.random.default_rng(seed).standard_normal((HEIGHT // cell_px + 2, WIDTH // cell_px + 2)).astype(np.float32)
    return cv2.resize(grid, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def test_light_depth_recovers_lambertian_surface():
    found, true = depth_of(picture(bowl())), bowl()
    assert found.doubt is None
    assert (found.origin, found.metric) == (DEPTH_ORIGINS["light"], False)
    # Measured 0.19 of the level plane's error; the best tilted plane, which needs no light, has 0.75 of it.
    assert error(found.depth, true) < 0.3 * error(plane(), true)
    assert found.confidence.min() > 0.5


def test_light_depth_independent_of_light_intensity():
    dim, bright = depth_of(picture(bowl(), light=0.15)), depth_of(picture(bowl(), light=0.3))
    assert error(dim.depth, bright.depth) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_light_depth_textured_plane_stays_flat(seed):
    pigment = np.exp(-np.maximum(noise(seed, 12), 0)[..., None] * np.array([0.3, 0.9, 0.8]))
    found = depth_of(picture(plane(), PINK * pigment))
    depth = plane() if found.doubt else found.depth
    assert error(depth, plane()) < 0.04


def test_light_depth_recovers_relief_despite_pigment():
    pigment = np.exp(-np.maximum(noise(3, 8), 0)[..., None] * np.array([0.3, 0.9, 0.8]))
    found, true = depth_of(picture(bowl(), PINK * pigment)), bowl()
    # Measured 0.22 to 0.26 over six pigments; the best tilted plane has 0.75.
    assert error(found.depth, true) < 0.35 * error(plane(), true)


def test_shading_channel_mixture_suppresses_pigment():
    pigment = np.exp(-np.maximum(noise(3, 4), 0)[..., None] * np.array([0.3, 0.9, 0.8]))
    mixed = shading_in(SmallPicture.of(Frame(0, 0, picture(plane(), PINK * pigment))))
    red = shading_in(SmallPicture.of(Frame(0, 0, np.repeat(picture(plane(), PINK * pigment)[..., :1], 3, axis=2))))
    assert mixed.detail < 0.5 * red.detail


@pytest.mark.parametrize("level", [0, 8, 252, 255])
def test_light_depth_dark_and_overexposed_frames_are_unseen(level):
    found = depth_of(np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    assert found.doubt == UNSEEN
    assert not found.confidence.any()


def test_light_depth_untextured_facing_plane_is_flat():
    assert depth_of(picture(plane())).doubt == FLAT


def test_light_depth_frame_full_of_tools_is_unseen():
    assert depth_of(picture(bowl()), mask=np.zeros((HEIGHT, WIDTH), np.uint8)).doubt == UNSEEN


def test_light_depth_confidence_low_under_tool():
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, 100:] = 0
    found = depth_of(picture(bowl()), mask=mask)
    assert found.confidence[:, :60].min() > 0.5
    assert found.confidence[:, 150:].max() < 0.5


@pytest.mark.slow
def test_light_depth_is_stable_and_deterministic():
    first, second = LightDepth(), LightDepth()
    rng = np.random.default_rng(0)
    depths = []
    for seq in range(41):
        image = np.clip(picture(bowl()) + rng.normal(0, 3, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
        frame = Frame(seq, seq * 33_000_000, image)
        found, again = first.estimate(frame, CAMERA), second.estimate(frame, CAMERA)
        assert np.array_equal(found.depth, again.depth)
        depths.append(found.depth)
    assert np.array_equal(depths[1], depths[9])
    assert 0 < error(depths[40], depths[30]) < 0.01


@pytest.mark.slow
def test_light_depth_restarts_for_new_scene_size_or_pose():
    estimator = LightDepth()
    estimator.estimate(Frame(0, 0, picture(bowl())), CAMERA)
    mirrored = picture(bowl()[:, ::-1])
    alone = depth_of(mirrored).depth
    assert np.array_equal(estimator.estimate(Frame(1, 1, mirrored, new_scene="cut"), CAMERA).depth, alone)
    moved = np.eye(4)
    moved[0, 3] = 1
    assert np.array_equal(
        estimator.estimate(Frame(2, 2, picture(bowl())), CAMERA.with_pose(moved)).depth, depth_of(picture(bowl())).depth
    )
    small = cv2.resize(picture(bowl()), (80, 64), interpolation=cv2.INTER_AREA)
    assert estimator.estimate(Frame(3, 3, small), CAMERA.scaled(0.5)).depth.shape == (64, 80)


def test_light_depth_is_none_for_fisheye_camera():
    fisheye = Camera(CAMERA.K, WIDTH, HEIGHT, CAMERA.world_to_camera, model="fisheye")
    assert LightDepth().estimate(Frame(0, 0, picture(bowl())), fisheye) is None


def test_light_depth_registered_by_name():
    assert DEPTHS["light"] is LightDepth


def test_share_of_distance_half_at_brightness_change_of_error_size():
    grid = Grid.of(CAMERA, (32, 40))
    relief = np.zeros((1, len(grid.half_waves)))
    relief[0, 0] = 1.0
    values = Places.at(grid, *grid.middles()).value @ relief[0]
    relief *= 0.05 / 2 / np.std(values)
    assert light.share_of_distance(grid, relief) == pytest.approx(0.5)
    assert light.share_of_distance(grid, 2 * relief) == pytest.approx(0.8)


def test_light_confidence_halves_over_twentieth_of_longer_side():
    known = np.zeros((32, 40), bool)
    known[:, :10] = True
    found = light._near_seen(SimpleNamespace(known=known))
    np.testing.assert_allclose(found[5, [9, 11, 13]], [1, 0.5, 0.25])


@pytest.mark.parametrize(("share", "is_enough"), [(0.25, True), (0.24, False)])
def test_light_depth_requires_quarter_of_image(share, is_enough):
    known = np.arange(100) < round(100 * share)
    assert light.shows_enough(SimpleNamespace(shading=SimpleNamespace(known=known))) == is_enough


@pytest.mark.parametrize(("elapsed_s", "is_new"), [(0.29, False), (0.3, True)])
def test_light_depth_re_estimated_every_0_3_seconds(elapsed_s, is_new):
    estimator, frame = LightDepth(), Frame(0, 0, picture(bowl()))
    first = estimator.estimate(frame, CAMERA)
    second = estimator.estimate(Frame(1, round(elapsed_s * 1e9), picture(bowl())), CAMERA)
    assert (second is not first) == is_new


def test_light_depth_re_estimated_only_after_scope_motion(monkeypatch):
    answers = iter("abc")
    monkeypatch.setattr(LightDepth, "_estimated", lambda self, frame, camera: next(answers))
    monkeypatch.setattr(LightDepth, "_resized", lambda self, frame: False)
    estimator, moved = LightDepth(), np.eye(4)
    moved[2, 3] = 1.0
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    cameras = [CAMERA, CAMERA, CAMERA.with_pose(moved), CAMERA.with_pose(moved.copy()), CAMERA]
    found = [estimator.estimate(Frame(seq, seq, image), camera) for seq, camera in enumerate(cameras)]
    assert found == ["a", "a", "b", "b", "c"]


@pytest.fixture
def averaged(monkeypatch):
    """Return the reliefs that are shown, from those of the pictures of each window: one list per window and picture."""
    shown, windows = [], []

    class Window:
        def __init__(self, grid, newest, recent=()):
            self.pictures = [*recent, newest]
            self.kept = recent
            windows.append(self)

        def add(self, newest):
            if newest is refused.get("newest"):
                return False
            self.pictures.append(newest)
            return True

        def relief_of(self, newest):
            return next(
                (np.array([newest.value + 100.0 * len(windows)]) for each in self.pictures if each is newest), None
            )

    refused = {}
    monkeypatch.setattr(light, "LightWindow", Window)
    monkeypatch.setattr(light, "answer", lambda grid, relief, newest, frame: shown.append(relief) or "depth")
    monkeypatch.setattr(light.Grid, "of", lambda camera, shape: None)

    def found(values, refuse=None):
        estimator = light.LightDepth()
        for number, value in enumerate(values):
            newest = SimpleNamespace(value=value, shading=SimpleNamespace(known=np.ones(1), brightness=np.ones(1)))
            monkeypatch.setattr(light, "shaded_picture", lambda frame, camera, newest=newest: newest)
            if number == refuse:
                refused["newest"] = newest
            estimator._estimated(None, None)
        return [float(each[0]) for each in shown], windows

    return found


def test_reliefs_average_follows_changes_within_window(averaged):
    """All pictures of a window show the same relief here, so the average follows their change at once."""
    found, windows = averaged([1.0, 2.0, 5.0, 3.0, 3.0, 3.0, 9.0])
    np.testing.assert_allclose(found, [101.0, 102.0, 105.0, 103.0, 103.0, 103.0, 109.0])
    assert len(windows) == 1


def test_reliefs_of_new_window_weighted_by_count_and_at_least_fifth(averaged):
    """The second window starts with a different relief and without the previous picture."""
    found, windows = averaged([1.0, 1.0, 4.0, 6.0], refuse=2)
    # The third picture has no relation to the second: a third of 204 and two of 101, and then its change by 2.
    expected = 101 + (204 - 101) / 3
    expected_next = expected + 2 + (206 - expected - 2) / 4
    np.testing.assert_allclose(found, [101.0, 101.0, expected, expected_next])
    late, _ = averaged([1.0] * 8 + [4.0], refuse=8)
    assert late[-1] - late[-2] == pytest.approx((100 * len(windows) + 4 - late[-2]) / 5)


def test_light_window_of_13_images_succeeded_by_window_of_newest_seven(averaged):
    _, windows = averaged([1.0] * 13)
    assert len(windows) == 2 and len(windows[0].pictures) == 13 and len(windows[1].pictures) == 7
    assert windows[1].pictures[:6] == windows[0].pictures[6:12]
