"""Engine process: settings, alternation between reconstruction and models, exit codes."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pytest

from gsplat_core.errors import InvalidSetting
from operators.errors import SourceUnavailable
from services.supervisor import engine as engines
from services.supervisor.launcher import NO_USE
from services.supervisor.worker import ENGINE_ON_CPU, EngineSpec, ProcessSpec


def test_live_settings_take_over_engine_spec(tmp_path):
    chosen = {
        "device": "cuda", "field": "basis", "renderer": "alpha", "seed": 5, "tool_mask": "none", "depth": "light",
        "eyes": "both", "poses": "estimated", "out_of_body": "off",
    }  # fmt: skip
    settings = engines.live_settings(EngineSpec(**chosen, budget_ms=70.0), tmp_path / "out", "scope")
    assert {name: getattr(settings, name) for name in chosen} == chosen
    assert (settings.source, settings.out, settings.budget_ms) == ("scope", tmp_path / "out", 70.0)
    assert not settings.report, "an endless session writes no output that grows"


@pytest.mark.parametrize("again", [False, True])
def test_started_runs_trial_and_warm_up_on_first_start_only(monkeypatch, again):
    calls = []
    monkeypatch.setattr(engines, "new_parts", lambda settings, source: calls.append(("new", settings)) or "parts")
    monkeypatch.setattr(engines, "warm_up", lambda settings, source: calls.append(("warm", settings)) or "warm parts")
    monkeypatch.setattr(engines, "live_graph", lambda source, settings, parts: (source, settings, parts))
    monkeypatch.setattr(
        engines, "trial_run", lambda settings, source, new: calls.append(("trial", new("made up", "tried")))
    )
    found = engines.started("settings", "source", again)
    if again:
        assert (found, calls) == ("parts", [("new", "settings")])
    else:
        assert found == "warm parts"
        assert calls == [("new", "tried"), ("trial", ("made up", "tried", "parts")), ("warm", "settings")]


class Recorder:
    """Records method calls by name."""

    def __init__(self, **values):
        self.calls = []
        self.__dict__.update(values)

    def __getattr__(self, name):
        return lambda *arguments, **named: self.calls.append((name, *arguments))

    def names(self):
        return [call[0] for call in self.calls]


@pytest.fixture
def shown(monkeypatch):
    """Fakes for `show`; `world.steps` are called in turn by the reconstruction and by waits."""
    world = SimpleNamespace(stopped=False, reconstructed=[], opened=[])
    models = Recorder(figures=lambda: {"m": 1}, show="SHOW", show_live="LIVE", show_previous="PREVIOUS")
    layers = Recorder(figures=lambda: {"l": 2}, camera="CAMERA")
    screen = Recorder(wanted="live", figures=lambda: {"s": 3}, ages=SimpleNamespace(as_json=lambda: "AGES"))
    worker = Recorder(stop_requested=lambda: world.stopped)
    monkeypatch.setattr(engines, "ModelShow", lambda *parts: models)
    monkeypatch.setattr(engines, "check_device", lambda device: world.opened.append(device))
    monkeypatch.setattr(engines, "check_renderer", lambda renderer, device, options: world.opened.append(renderer))

    def reconstruct(worker, spec, screen, layers, snapshots, *, again):
        world.reconstructed.append(again)
        world.steps.pop(0)()

    worker.wait = lambda seconds: (worker.calls.append(("wait", seconds)), world.steps.pop(0)())
    monkeypatch.setattr(engines, "reconstruct", reconstruct)
    world.models, world.layers, world.screen, world.worker = models, layers, screen, worker
    world.run = lambda again=False: engines.show(worker, EngineSpec(), screen, layers, again)
    return world


def test_show_alternates_reconstruction_and_model_and_closes_parts(shown):
    def want(what):
        return lambda: setattr(shown.screen, "wanted", what)

    stop = lambda: setattr(shown, "stopped", True)
    shown.steps = [want("model"), want("model"), want("live"), stop]
    shown.run()
    assert shown.reconstructed == [False, True], "the second start is not the first"
    assert shown.opened == ["cpu", "alpha"]
    assert shown.models.names() == ["begin", "close"] and shown.layers.names() == ["open", "close"]
    assert ("say", "running", "shows a finished model") in shown.worker.calls
    assert shown.worker.names().count("wait") == 2 and "request_stop" not in shown.worker.names()
    taken = {name: call for call in shown.worker.calls if call[0] == "take" for name, call in call[1].items()}
    assert taken.keys() == {"camera", "snapshot", "show_model", "show_live", "show_previous"}
    reported = {call[0]: call[2]() for call in shown.worker.calls if call[0].startswith("tell_")}
    assert reported == {"tell_figures": {"s": 3, "m": 1, "l": 2}, "tell_measures": {"ages": "AGES"}}


def test_show_passes_again_to_first_reconstruction(shown):
    shown.steps = [lambda: setattr(shown, "stopped", True)]
    shown.run(again=True)
    assert shown.reconstructed == [True]


def test_show_requests_stop_and_closes_parts_on_error(shown):
    def fail():
        raise InvalidSetting("no")

    shown.steps = [fail]
    with pytest.raises(InvalidSetting):
        shown.run()
    assert ("request_stop", "the engine failed") in shown.worker.calls
    assert shown.models.names()[-1] == shown.layers.names()[-1] == "close"


@pytest.fixture
def reconstructing(monkeypatch):
    """Fakes for `reconstruct`, whose session calls `world.during(graph, stop_requested)`."""
    world = SimpleNamespace(said=[], reported={}, during=lambda graph, stop: None, snapshots_open=[])
    about = SimpleNamespace(name="scope", camera="camera")

    class Source:
        def __init__(self, folder, stop_requested, scale_for):
            self.description, world.scale = about, scale_for(about)
            world.source_stop = stop_requested

    class Graph:
        def __init__(self, source, settings, parts, *, stop_requested, on_scored, on_shown):
            self.parts, self.on_scored, self.on_shown = parts, on_scored, on_shown
            self.reconstruct = SimpleNamespace(newest="NEWEST")

    class FakeSession:
        def __init__(self, graph, stated, *, command, stop_requested):
            assert command == "live"
            self.execute = lambda: world.during(graph, stop_requested)

    @contextmanager
    def of(graph):
        world.snapshots_open.append(True)
        yield
        world.snapshots_open.append(False)

    def scale(spec, about, cached, measure):
        world.measured = measure(about, 0.5)
        return 0.25

    for name, value in {
        "CapturedSource": Source, "live_graph": Graph, "Session": FakeSession, "low_latency": nullcontext,
        "started": lambda settings, source, again: ("parts", again), "engine_scale": scale,
        "check_picture": lambda camera, scale: world.__setattr__("checked", (camera, scale)),
        "measured_size": lambda settings, about, share: (settings.source, share),
        "scene_of": lambda shown, newest: (shown, newest), "graph_figures": lambda graph: {"graph": "figures"},
        "graph_measures": lambda graph: {"graph": "measures"},
    }.items():  # fmt: skip
        monkeypatch.setattr(engines, name, value)
    world.worker = SimpleNamespace(
        stop_requested=lambda: world.stopped,
        say=lambda state, reason: world.said.append((state, reason)),
        tell_figures=lambda part, call: world.reported.setdefault("figures", []).append(call()),
        tell_measures=lambda part, call: world.reported.setdefault("measures", []).append(call()),
        folder=SimpleNamespace(engine_size="size file"),
    )
    world.stopped = False
    world.screen = SimpleNamespace(wanted="live", scored=lambda score: None, show=lambda shown: shown == "new")
    world.offered = []
    layers = SimpleNamespace(offer=lambda make: world.offered.append(make()))
    snapshots = SimpleNamespace(of=of)
    world.run = lambda: engines.reconstruct(world.worker, EngineSpec(), world.screen, layers, snapshots, again=True)
    return world


def test_reconstruct_reports_states_scores_pictures_and_figures(reconstructing):
    world, scores = reconstructing, []
    world.screen.scored = scores.append

    def during(graph, stop):
        assert graph.parts == ("parts", True) and world.snapshots_open == [True]
        graph.on_scored(graph, "score")
        for picture in ("new", "repeated"):
            graph.on_shown(picture)

    world.during = during
    world.run()
    assert world.said == [
        ("starting", "waits for the source to be opened by the capture process"),
        ("starting", "measures at which size it keeps up"),
        ("starting", "prepares the reconstruction"),
        ("running", "reconstructs"),
    ]
    assert scores == ["score"] and world.offered == [("new", "NEWEST")], "layers are drawn for new pictures only"
    assert world.reported == {"figures": [{"graph": "figures"}, {}], "measures": [{"graph": "measures"}, {}]}
    assert world.checked == ("camera", 1.0) and world.measured == ("scope", 0.5) and world.scale == 0.25
    assert world.snapshots_open == [True, False]


@pytest.mark.parametrize(
    ("stopped", "wanted", "ends"), [(False, "live", False), (True, "live", True), (False, "model", True)]
)
def test_reconstruct_stops_on_stop_request_or_wanted_model(reconstructing, stopped, wanted, ends):
    world, asked = reconstructing, []
    world.stopped, world.screen.wanted = stopped, wanted
    world.during = lambda graph, stop: asked.append(stop())
    world.run()
    assert asked == [ends] and world.source_stop() == ends


def test_graph_figures_are_empty_before_run_and_complete_during_run():
    assert engines.graph_figures(SimpleNamespace()) == engines.graph_figures(SimpleNamespace(metrics=None)) == {}
    source = SimpleNamespace(state=SimpleNamespace(value="live"), counts=lambda: {"late": 1})
    counts = SimpleNamespace(frames=3, steps=9, passed_over=2, withheld={"blur": 4}, withheld_now={"blur": 1})
    graph = SimpleNamespace(
        metrics=object(),
        frame_source=source,
        source_op=SimpleNamespace(emitted=11),
        reconstruct=SimpleNamespace(counts=counts, newest_gaussians=70),
    )
    found = engines.graph_figures(graph)
    assert found == {
        "frames": 11, "trained": 3, "steps": 9, "passed_over": 2, "withheld": {"blur": 4}, "withheld_now": {"blur": 1},
        "gaussians": 70, "source": "live", "source_counts": {},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("error", "code"), [(None, 0), (SourceUnavailable("not open yet"), 0), (InvalidSetting("wrong"), NO_USE)]
)
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_engine_exit_code_tells_if_restart_is_useful(runtime, monkeypatch, error, code, device):
    path = ProcessSpec(stream="a", engine=EngineSpec(device=device)).write(runtime.stream("a"))
    publisher, seen = Recorder(), {}

    def show(worker, engine, screen, layers, again):
        seen.update(again=again)
        if error is not None:
            raise error

    for name, value in {
        "Worker": lambda folder, spec: nullcontext("worker"), "scratch_folder": nullcontext, "show": show,
        "PicturePublisher": lambda endpoint: publisher, "Layers": lambda folder, device: None, "Screen": lambda p: None,
        "step_back": lambda nice: seen.update(nice=nice),
        "keep_files_private": lambda: seen.update(private=True),
    }.items():  # fmt: skip
        monkeypatch.setattr(engines, name, value)
    monkeypatch.setattr(engines.logging, "basicConfig", lambda **_: None)
    assert engines.main(["--spec", str(path), "--again"]) == code
    assert seen["again"] and seen["private"] and publisher.names() == ["close"]
    assert seen.get("nice") == (ENGINE_ON_CPU if device == "cpu" else None), "a GPU's engine keeps its priority"
