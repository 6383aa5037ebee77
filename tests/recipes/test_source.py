"""CONTRIBUTING's recipe "A source", followed by a test alone: a pattern that moves, run through a replay."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.applications.reconstruct import reconstruct
from operators.applications.replay import ReplaySettings, replay
from operators.ingest import SourceResult
from operators.metrics import QualityResult
from operators.sources.registry import SOURCES, SourceOptions
from operators.sources.source import SourceDescription, ThreadedSource


class PatternSource(ThreadedSource):
    """A smooth pattern that moves to the left, of which every fifth frame is lost."""

    def __init__(self, width_px: int, height_px: int, count: int | None, digest: str | None) -> None:
        super().__init__()
        camera = Camera.from_focal(float(width_px), width_px, height_px)
        self.description = SourceDescription(
            "pattern", width_px, height_px, 25.0, camera, frame_count=count, digest=digest
        )

    def frames(self) -> Iterator[Frame]:
        about = self.description
        x, y = np.linspace(0, 3, about.width_px)[None, :, None], np.linspace(0, 2, about.height_px)[:, None, None]
        given, seq = 0, 0
        while given != about.frame_count:
            if seq % 5 != 4:
                image = (120 + 100 * np.sin(x + y + np.arange(3) + 0.05 * seq)).astype(np.uint8)
                yield Frame(seq=seq, pts_ns=seq * 40_000_000, image=image)
                given += 1
            seq += 1


def pattern(address: str, options: SourceOptions) -> PatternSource:
    """`pattern://64x48`: the size; with `?again` at its end it says that it gives the same frames every time."""
    size, _, again = address.partition("?")
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InvalidSetting(f"the size of a pattern is {size!r}; give it as pattern://64x48")
    width_px, height_px = (round(int(side) * options.scale) for side in (width, height))
    return PatternSource(width_px, height_px, options.max_frames, "ab" * 32 if again else None)


@pytest.fixture(autouse=True)
def registered():
    SOURCES.add("pattern", pattern)
    yield
    SOURCES.remove("pattern")


@pytest.mark.parametrize("address", ["pattern://64x48", Path("pattern://64x48")])
def test_it_runs_through_a_replay(tmp_path, address):
    outcome = replay(ReplaySettings(address, tmp_path / "out", steps_per_frame=1, max_frames=8, heldout=True))
    source, quality = outcome.find(SourceResult), outcome.find(QualityResult)
    assert source.frames == 8 and source.description.name == "pattern" and outcome.stop_reason == "end of recording"
    assert [entry["seq"] for entry in quality.series] == [0, 1, 2, 3, 5, 6, 7, 8], "numbers may be missing"
    assert [entry["seq"] for entry in quality.series if not entry["trained"]] == [1], "held out by its number"
    assert quality.trained.means()["psnr_tissue_db"] > 25
    assert quality.previous_frame_db > 10 and quality.heldout_between.frames == 1
    assert {"video", "model", "frames"} == set(outcome.outputs)


def test_options_reach_a_source_that_can_be_read_again(tmp_path):
    settings = ReplaySettings("pattern://64x48?again", tmp_path / "out", steps_per_frame=1, max_frames=3, scale=0.5)
    outcome = replay(settings)
    about = outcome.find(SourceResult).description
    assert (about.width_px, about.height_px, about.frame_count) == (32, 24, 3)
    assert outcome.find(QualityResult).previous_frame_db > 20


def test_same_frames_give_same_bytes(tmp_path):
    digests = {
        replay(ReplaySettings("pattern://64x48", tmp_path / name, steps_per_frame=1, max_frames=4))
        .find(QualityResult)
        .frames_sha256
        for name in "ab"
    }
    assert len(digests) == 1


def test_what_replay_cannot_use_is_refused_before_anything_is_written(tmp_path):
    for address, options, message in (
        ("pattern://64x48", {}, "pattern has no end; give --max-frames"),
        ("pattern://wide", {"max_frames": 2}, "the size of a pattern is 'wide'"),
        ("patern://64x48", {"max_frames": 2}, "unknown source 'patern'; known are recording, .*pattern"),
    ):
        with pytest.raises(InvalidSetting, match=message):
            replay(ReplaySettings(address, tmp_path / "out", **options))
    with pytest.raises(InvalidSetting, match="reconstruct needs a recording"):
        reconstruct(ReplaySettings("pattern://64x48", tmp_path / "out", max_frames=2), steps=1)
    assert not (tmp_path / "out").exists()
