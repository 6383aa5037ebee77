"""Tissue outside the current picture is scored against the truth if it was seen before, next to trivial baselines."""

from __future__ import annotations

import numpy as np
import pytest

from gsplat_core.errors import RecordingInvalid
from gsplat_core.io.recordings import open_recording, synthesize
from gsplat_core.io.recordings.synthetic.scene import Extras
from gsplat_core.io.recordings.truth import open_behind, open_truth
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import FrameStatus
from operators.outcome import OutcomeBuilder
from operators.truth import SCORED_EVERY, TruthOp, TruthResult

HEIGHT, WIDTH = 32, 48


class Known:
    """Tissue of one colour and depth for all frames."""

    def __init__(self, level=100, depth_mm=50.0):
        self.image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
        # A slope: a level plane is off.
        self.depth = np.broadcast_to(
            np.linspace(depth_mm, 1.2 * depth_mm, WIDTH, dtype=np.float32), (HEIGHT, WIDTH)
        ).copy()
        self.asked = []

    def of(self, frame):
        self.asked.append(frame.seq)
        return self.image, self.depth


def tool(left, right):
    mask = np.ones((HEIGHT, WIDTH), np.uint8)
    mask[:, left:right] = 0
    return mask


def run(frames_and_pictures, known, frame, rendered, compute, frame_count=9):
    camera = Camera.from_focal(40.0, WIDTH, HEIGHT)
    operator = TruthOp(None, behind=known, camera=camera, frame_count=frame_count)
    operator.start()
    for seq, (level, shown, mask, more) in enumerate(frames_and_pictures):
        image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
        if mask is not None:
            image[mask == 0] = 240
        source = frame(seq, image=image, mask=mask, **more)
        plane = known.depth * 1.02
        compute(
            operator,
            rendered=rendered(frame=source, image=np.full_like(image, shown), depth=plane, alpha=np.ones_like(plane)),
        )
    outcome = OutcomeBuilder()
    operator.contribute(outcome)
    return outcome.find(TruthResult)


def decibels(grey_levels):
    return 20 * np.log10(255 / grey_levels)


def test_tissue_seen_before_is_scored_with_baselines(frame, rendered, compute):
    known = Known(100)
    # Seen at level 90, then hidden; the tissue around the tool is at 108 by then.
    frames = [(90, 0, tool(0, 0), {})] * 3 + [(95, 0, tool(30, 40), {}), (108, 104, tool(10, 20), {})]
    found = run(frames, known, frame, rendered, compute)
    assert found.behind_tools.frames == 1
    assert found.behind_tools.psnr_db == pytest.approx(decibels(4))
    # Columns 10 to 20 were seen last in frame 3, at level 95.
    assert found.behind_tools.last_seen_db == pytest.approx(decibels(5))
    assert found.behind_tools.inpainted_db == pytest.approx(decibels(8), abs=0.5)


def test_never_seen_tissue_is_not_scored(frame, rendered, compute):
    frames = [(100, 100, tool(10, 20), {})] * 9
    found = run(frames, Known(), frame, rendered, compute)
    assert found.behind_tools is None and found.depth is not None and found.depth_behind_tools is None


def test_truth_skips_damaged_and_unmasked_frames(frame, rendered, compute):
    known = Known()
    damaged = {"status": FrameStatus.DAMAGED}
    frames = [(90, 0, None, {}), (90, 0, tool(0, 0), damaged), (90, 0, tool(0, 0), damaged), (90, 0, None, {})]
    frames += [(90, 0, tool(10, 20), {})]
    found = run(frames, known, frame, rendered, compute)
    assert found.behind_tools is None, "what a damaged frame shows was not seen"
    assert known.asked == [4]


def test_truth_depth_is_compared_with_plane_baselines(frame, rendered, compute):
    found = run([(90, 90, tool(0, 0), {})] + [(90, 90, tool(10, 20), {})] * 4, Known(), frame, rendered, compute)
    for share in (found.depth, found.depth_behind_tools):
        assert share.rmse_share == pytest.approx(0.02, abs=0.002)
        assert share.level_rmse_share > share.plane_rmse_share
    assert found.depth.level_rmse_share > 2 * share.level_rmse_share, "behind the tool the slope is short"


def test_truth_scores_bounded_number_of_frames(frame, rendered, compute):
    for count, expected in ((9, SCORED_EVERY), (6400, 100)):
        camera = Camera.from_focal(40.0, WIDTH, HEIGHT)
        assert TruthOp(None, behind=Known(), camera=camera, frame_count=count).every == expected


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("behind") / "recording"
    return synthesize(folder, frames=3, width_px=96, height_px=80, stereo=False, extras=Extras(behind=True))


def test_synthesize_writes_tissue_behind_tool(recorded):
    behind, truth = open_behind(recorded, 3), open_truth(recorded, 3)
    assert truth.behind is not None
    for frame in open_recording(recorded):
        image, depth = behind.of(frame)
        tissue = frame.mask != 0
        assert 0 < tissue.mean() < 1
        np.testing.assert_array_equal(image[tissue], frame.image[tissue])
        np.testing.assert_allclose(depth[tissue], frame.depth[tissue], atol=0.011)
        inside = ~tissue & (depth - frame.depth > 1)
        assert inside.sum() > 0.5 * (~tissue).sum(), "tissue is farther away than the tool in front of it"
        assert (image[inside] != frame.image[inside]).any(axis=-1).mean() > 0.9
    assert behind.of(frame.with_fields(seq=3)) is None


def test_behind_is_scaled_to_frame_and_not_part_of_recording(recorded, tmp_path):
    plain = synthesize(tmp_path / "plain", frames=3, width_px=96, height_px=80, stereo=False)
    small = next(iter(open_recording(recorded, scale=0.5)))
    image, depth = open_behind(recorded, 3).of(small)
    assert image.shape == (40, 48, 3) and depth.shape == (40, 48)
    for before, after in zip(open_recording(plain), open_recording(recorded), strict=True):
        np.testing.assert_array_equal(before.image, after.image)
    assert open_behind(plain, 3) is None and open_truth(plain, 3).behind is None


def test_unreadable_truth_error_names_file(recorded, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(recorded, copy)
    first = sorted((copy / "behind/images").iterdir())[0]
    first.write_bytes(b"no picture")
    with pytest.raises(RecordingInvalid, match=first.name):
        open_behind(copy, 3).of(next(iter(open_recording(copy))))
    first.unlink()
    with pytest.raises(RecordingInvalid, match="2 pictures for 3 frames"):
        open_behind(copy, 3)


def test_replay_reports_truth_of_synthetic_recording(recorded, tmp_path):
    from operators.applications.replay import ReplaySettings, replay
    from services.reports.build import write_reports

    outcome = replay(ReplaySettings(recording=recorded, out=tmp_path / "out", steps_per_frame=2))
    found = outcome.find(TruthResult)
    assert found.depth.frames == 1 and found.depth.rmse_share < found.depth.level_rmse_share
    report = write_reports(outcome, tmp_path / "out")
    assert report.quality.truth.depth.reconstruction == found.depth.rmse_share
    page = (tmp_path / "out/report.html").read_text()
    assert "What the camera does not show" in page and "Depth that is seen, RMS error of 1 frames" in page
    assert page.count('alt="frame 2, tissue behind the tool"') == page.count('alt="frame 2, from the side"') == 1
