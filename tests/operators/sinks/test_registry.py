"""Sinks chosen by name."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidInput, InvalidSetting
from operators.applications.replay import ReplaySettings
from operators.messages import RenderedFrame
from operators.metrics import ScoredFrame
from operators.settings import SINKS
from operators.sinks.sink import CallbackSinkOp, SinkOptions, input_of
from operators.sources.recording import RecordingSource
from operators.storage import StorageReserve


def test_registered_sinks_take_rendered_or_scored_frames(tmp_path, recording):
    options = SinkOptions(tmp_path, RecordingSource(recording).description, StorageReserve(tmp_path, lambda: 0))
    made = {name: SINKS[name](None, name, options) for name in SINKS}
    assert {name: input_of(sink) for name, sink in made.items()} == {
        "video": ("rendered", RenderedFrame),
        "keyframes": ("scored", ScoredFrame),
    }
    assert [sink.name for sink in made.values()] == ["video", "keyframes"]
    assert made["video"].path.parent == tmp_path and made["video"].fps == recording.fps


def test_input_of_refuses_sink_with_untyped_input():
    with pytest.raises(InvalidInput, match="it must have one, declared with type=RenderedFrame or type=ScoredFrame"):
        input_of(CallbackSinkOp(None, name="any", callback=print))


def test_replay_settings_refuse_unknown_sink(tmp_path):
    with pytest.raises(InvalidSetting, match=r"sinks is \('hologram',\); choose video or keyframes"):
        ReplaySettings(tmp_path, tmp_path / "out", sinks=("hologram",))
