"""Retention protocol: the last seconds, and places that were visited twice."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import InvalidInput
from gsplat_core.evaluation.protocols import MAX_POSES, PlaceFinder, Visits, evaluate_retention, find_places, returns
from gsplat_core.scene.frames import FrameStatus


def test_retention_compares_last_seconds_with_frozen_image(frame, picture, decibels):
    frames = [frame(k, 100 + k) for k in range(11)]  # 0 to 0.4 s
    asked, log = [], []

    def picture_of(each):
        asked.append(each.seq)
        return picture(int(each.image[0, 0, 0]) + 4)

    found = evaluate_retention(frames, picture_of, window_s=(0.0, 0.4), last_s=0.1, record=log.append)
    assert asked == [8, 9, 10] == [entry["seq"] for entry in log]
    assert found.last.psnr_tissue_db == pytest.approx(decibels(4), abs=1e-6)
    assert found.last_range_s == pytest.approx((0.3, 0.4))
    assert found.frozen.psnr_tissue_db == pytest.approx((decibels(1) + decibels(2)) / 2, abs=1e-6)
    assert found.frozen.frames == 2, "against itself it says nothing"
    assert found.places == ()


def test_retention_renders_short_stream_within_model_window(frame, picture):
    asked = []
    evaluate_retention(
        [frame(k) for k in range(6)], lambda f: asked.append(f.seq) or picture(100), window_s=(0.04, 0.16), last_s=5
    )
    assert asked == [1, 2, 3, 4]


def test_retention_omits_damaged_frames(frame, picture):
    frames = [frame(0), frame(1, status=FrameStatus.DAMAGED)]
    found = evaluate_retention(frames, lambda _: picture(100), window_s=(0, 1))
    assert found.last.left_out == {"damaged": 1} and found.last.frames == 1
    assert found.frozen.psnr_tissue_db is None


def test_retention_rejects_iterator(frame, picture):
    with pytest.raises(InvalidInput, match="twice"):
        evaluate_retention(iter([frame(0)]), lambda _: picture(0), window_s=(0, 1))


def test_retention_scores_both_visits_of_place(frame, picture, decibels):
    frames = [frame(k, 100) for k in range(10)]
    place = Visits((0.0, 0.04), (0.2, 0.24))
    shown = lambda each: picture(102 if each.seq < 3 else 110)
    (found,) = evaluate_retention(frames, shown, window_s=(0, 1), last_s=0.001, places=[place]).places
    assert (found.first.frames, found.again.frames) == (2, 2)
    assert found.first.psnr_tissue_db == pytest.approx(decibels(2), abs=1e-6)
    assert found.again.psnr_tissue_db == pytest.approx(decibels(10), abs=1e-6)


def test_returns_count_frames_until_place_is_recovered():
    place = Visits((0.0, 1.0), (3.0, 4.0))
    values = {0.5: 40.0, 3.0: 20.0, 3.1: None, 3.2: 33.0, 3.3: 36.0, 5.0: 39.0}
    log = [{"time_s": time_s, "psnr_tissue_db": value} for time_s, value in values.items()]
    (found,) = returns(log, [place])
    assert found.first_db == (20.0, None, 33.0) and found.frames_until_found == 3
    (never,) = returns(log[:2], [place])
    assert never.first_db == (20.0,) and never.frames_until_found is None
    with pytest.raises(InvalidInput, match="one after the other"):
        Visits((0, 2), (1, 3))


def pose(x=0.0, degrees=0.0):
    turn = np.radians(degrees)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
    matrix[:3, 3] = -matrix[:3, :3] @ [x, 0, 0]
    return matrix


def visits(positions):
    finder = PlaceFinder()
    for k, place in enumerate(positions):
        finder.add(k / 10, pose(*place))
    return finder.visits()


def test_place_finder_reports_return_of_scope():
    there = [(0.0,)] * 5
    away = [(x,) for x in np.linspace(10, 100, 10)]
    (found,) = visits([*there, *away, *away[::-1], *there])[-1:]
    assert found.first == pytest.approx((0.0, 0.4)) and found.again == pytest.approx((2.5, 2.9))


def test_place_finder_reports_rotation_and_ignores_length_unit():
    turned = [(0.0, 0.0)] * 3 + [(0.0, 50.0)] * 3 + [(0.0, 1.0)] * 3
    (found,) = visits(turned)
    assert found.again == pytest.approx((0.6, 0.8))
    far = [(0.0,), (1000.0,), (0.1,)]
    near = [(0.0,), (1.0,), (0.0001,)]
    assert len(visits(far)) == len(visits(near)) == 1


@pytest.mark.parametrize("positions", [[], [(0.0,)], [(0.0,)] * 30, [(float(k),) for k in range(30)]])
def test_place_finder_reports_nothing_without_return(positions):
    assert visits(positions) == []


def test_place_finder_limits_number_of_poses(frame):
    finder = PlaceFinder()
    for k in range(5 * MAX_POSES):
        finder.add(k / 10, pose(100.0 * (k // MAX_POSES % 2)))
    assert len(finder._poses) <= MAX_POSES
    assert len(finder.visits()) == 3


def test_find_places_ignores_frames_without_poses(frame):
    assert find_places([frame(k) for k in range(5)]) == []
    posed = [frame(k, pose=pose(x)) for k, x in enumerate((0.0, 50.0, 0.0))]
    assert [v.again for v in find_places(posed)] == [(0.08, 0.08)]
