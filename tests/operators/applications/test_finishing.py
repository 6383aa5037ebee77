"""After the graph the model is saved, and a source is read again."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from operators.applications import session as session_module
from operators.applications.session import FirstFrames, judged, saves_model
from operators.outcome import OutcomeBuilder
from operators.reconstruct import ModelResult
from operators.sources.source import SourceState


class Scripted:
    """Source that returns the given frames, and None where no frame arrived in time. Its state is that after the last read."""

    def __init__(self, given, digest="d"):
        self.given, self.calls = given, []
        self.description = SimpleNamespace(name="pipe -", digest=digest)

    @property
    def state(self):
        return SourceState.LIVE if self.left else SourceState.ENDED

    def open(self):
        self.calls.append("open")
        self.left = list(self.given)

    def read(self, timeout_s):
        assert self.calls[-1] == "open"
        return self.left.pop(0) if self.left else None

    def close(self):
        self.calls.append("close")


def session(**fields):
    values = {"stop_requested": lambda: False, "failure": None, "notes": [], "reached": OutcomeBuilder()}
    return SimpleNamespace(**(values | fields))


@pytest.mark.parametrize(
    ("given", "count", "frames"),
    [
        ([None, 1, None, None, 2, 3], 2, [1, 2]),
        ([1, 2, 3], 3, [1, 2, 3]),
        ([1, None, 2], 5, [1, 2]),
        ([1], 0, []),
        ([], 1, []),
    ],
)
def test_first_frames_reopens_source_for_each_iteration(given, count, frames):
    source = Scripted(given)
    first = FirstFrames(source, count)
    assert list(first) == frames and list(first) == frames
    assert source.calls == ["open", "close"] * 2


@pytest.mark.parametrize("reached_its_own", [True, False])
@pytest.mark.parametrize("has_fitted", [True, False])
def test_saves_model_prefers_trained_over_fitted_model(tmp_path, monkeypatch, reached_its_own, has_fitted):
    saved = []
    monkeypatch.setattr(session_module, "save_bundle", lambda model, folder: saved.append((model, folder)))
    run = session()
    if reached_its_own:
        run.reached.add(ModelResult("trained"))
    saves_model(tmp_path, "fitted" if has_fitted else None)(run)
    model = "trained" if reached_its_own else "fitted" if has_fitted else None
    assert saved == ([(model, tmp_path / "model")] if model else [])
    assert run.reached.outputs == ({"model": tmp_path / "model"} if model else {})
    result = run.reached.find(ModelResult)
    assert (None if result is None else result.model) == model


def test_field_of_view_search_ends_on_stop_request(monkeypatch, frame):
    monkeypatch.setattr(session_module, "seen_in_recording", lambda pictures: looked.extend(pictures))
    source = Scripted([frame(k) for k in range(12)])
    source.description.frame_count = 12
    source.description.height_px, source.description.width_px = frame(0).image.shape[:2]
    looked = []
    judged(source)
    assert len(looked) == 10, "frames 1 and 9 are held out"
    looked = []
    judged(source, lambda: len(source.left) <= 7)
    assert len(looked) == 3 and source.calls == ["open", "close"] * 2
