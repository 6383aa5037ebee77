"""Prometheus metrics of streams."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.registry import Collector

from services.api.observability import GraphFamilies, StreamMeasures
from services.bus.messages import BOUNDS_S, Durations
from services.display import KINDS
from services.supervisor.launcher import cause_of
from services.supervisor.process import StreamEvent


class Collected(Collector):
    def __init__(self, families):
        self.families = families

    def collect(self):
        return self.families.families()


def samples(families: GraphFamilies) -> dict[str, float]:
    """Return the samples in Prometheus' text format, by name."""
    registry = CollectorRegistry()
    registry.register(Collected(families))
    lines = generate_latest(registry).decode().splitlines()
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if not line.startswith("#")}


def durations(*values: float) -> dict:
    counted = Durations()
    for value in values:
        counted.add(value)
    return counted.as_json()


ENGINE = {
    "state": "running",
    "figures": {
        "frames": 9,
        "trained": 6,
        "pictures": 5,
        "steps": 12,
        "gaussians": 400,
        "passed_over": 3,
        "withheld": {"blur": 2},
        "source_counts": {"too_late": 1, "reconnections": 4},
        "picture": {"show": "model"},
        "model": {"name": "liver", "version": 3},
    },
}
CAPTURE = {"state": "stalled", "figures": {"frames": 10, "counts": {"clock_restarts": 2}}}


def test_graph_families_export_all_measures_of_stream():
    families = GraphFamilies()
    measures = {
        "ages": durations(0.02, 0.03, 9.0),
        "paths": {"source,display": durations(0.01)},
        "operators": {"display": durations(0.002)},
        "queues": {"a.x -> b.y": {"queued": 2, "dropped": {"drop_oldest": 7}}},
    }
    families.add("one", {"capture": CAPTURE, "engine": ENGINE}, measures)
    found = samples(families)
    assert found['intrasplat_frame_age_seconds_bucket{le="0.025",stream="one"}'] == 1
    assert found['intrasplat_frame_age_seconds_count{stream="one"}'] == 3
    assert found['intrasplat_frame_age_seconds_sum{stream="one"}'] == 9.05
    assert found['intrasplat_path_latency_seconds_count{path="source,display",stream="one"}'] == 1
    assert found['intrasplat_operator_duration_seconds_count{operator="display",stream="one"}'] == 1
    assert found['intrasplat_queue_depth{queue="a.x -> b.y",stream="one"}'] == 2
    stages = {"captured": 10, "taken": 9, "trained": 6, "shown": 5}
    assert {stage: found[f'intrasplat_frames_total{{stage="{stage}",stream="one"}}'] for stage in stages} == stages
    dropped = {"engine: too_late": 1, "passed over": 3, "withheld: blur": 2, "a.x -> b.y: drop_oldest": 7}
    assert dropped == {
        reason: found[f'intrasplat_frames_dropped_total{{reason="{reason}",stream="one"}}'] for reason in dropped
    }
    assert found['intrasplat_source_events_total{event="clock_restarts",role="capture",stream="one"}'] == 2
    assert found['intrasplat_source_events_total{event="reconnections",role="engine",stream="one"}'] == 4
    assert found['intrasplat_source_state{state="stalled",stream="one"}'] == 1
    assert found['intrasplat_source_state{state="live",stream="one"}'] == 0
    assert found['intrasplat_model_info{model="liver",show="model",stream="one",version="3"}'] == 1


def test_graph_families_of_starting_stream_have_source_state_only():
    families = GraphFamilies()
    families.add("one", {"capture": {"state": "starting", "figures": {}}, "engine": {"state": "down"}}, {"ages": "x"})
    assert {name.partition("{")[0] for name in samples(families)} == {"intrasplat_source_state"}


def test_live_model_info_has_no_version_label():
    families = GraphFamilies()
    engine = {"state": "running", "figures": {"picture": {"show": "live", "model_version": 812}, "model": None}}
    families.add("one", {"capture": CAPTURE, "engine": engine}, {})
    assert samples(families)['intrasplat_model_info{model="",show="live",stream="one",version=""}'] == 1


class Hub:
    """Display hub of a stream with one viewer of its picture."""

    def viewers(self, kind: str) -> int:
        return int(kind == "shown")

    def ages(self, kind: str) -> dict | None:
        return durations(0.02, 0.03) if kind == "shown" else None

    def counts(self, kind: str) -> dict[str, int]:
        return {"encoded": 5, "slow viewer": 2} if kind == "shown" else {}


def test_stream_measures_cover_processes_and_viewers_if_running():
    process = SimpleNamespace(measures={"ages": durations(0.5)}, causes={"killed by signal 9": 3, "heartbeat": 1})
    idle = SimpleNamespace(measures={}, causes={})
    running = SimpleNamespace(
        name="one", hub=Hub(), processes={"capture": idle, "engine": process},
        view=lambda: SimpleNamespace(state="behind", processes={"capture": CAPTURE, "engine": ENGINE}),
    )  # fmt: skip
    stopped = SimpleNamespace(name="two", hub=None, processes={}, view=lambda: SimpleNamespace(state="stopped"))
    measures = StreamMeasures()
    registry = CollectorRegistry()
    registry.register(measures)
    measures.streams = SimpleNamespace(streams=lambda: [stopped, running])
    for kind in ("started", "ended", "ended"):
        measures.count(StreamEvent("one", "engine", kind, "reason"))
    value = lambda name, **labels: registry.get_sample_value(f"intrasplat_{name}", labels)
    assert [value("stream_state", stream="one", state=each) for each in ("behind", "live", "stopped")] == [1, 0, 0]
    assert [value("stream_state", stream="two", state=each) for each in ("behind", "live", "stopped")] == [0, 0, 1]
    restarts = {"killed by signal 9": 3, "heartbeat": 1, "other": None}
    for reason, count in restarts.items():
        assert value("process_restarts_total", stream="one", role="engine", reason=reason) == count
    assert value("process_restarts_total", stream="one", role="capture", reason="heartbeat") is None
    assert value("process_events_total", stream="one", role="engine", kind="ended") == 2
    assert value("process_events_total", stream="one", role="engine", kind="started") == 1
    assert value("stream_viewers", stream="one", picture="shown") == 1
    assert value("stream_viewers", stream="two", picture="shown") is None
    assert value("pictures_encoded_total", stream="one", picture="shown") == 5
    assert value("pictures_dropped_total", stream="one", picture="shown", reason="slow viewer") == 2
    assert value("display_latency_seconds_count", stream="one", picture="shown") == 2
    assert value("display_latency_seconds_sum", stream="one", picture="shown") == 0.05
    assert value("frame_age_seconds_count", stream="one") == 1
    assert value("source_state", stream="one", state="stalled") == 1
    assert value("source_state", stream="two", state="stalled") is None
    other = next(kind for kind in KINDS if kind != "shown")
    assert value("stream_viewers", stream="one", picture=other) == 0
    assert value("display_latency_seconds_count", stream="one", picture=other) is None


def test_graph_measures_return_operators_paths_and_queues():
    from operators.graph import Application, Operator
    from services.supervisor.engine import graph_measures

    class Source(Operator):
        def setup(self, spec):
            spec.output("out")

        def compute(self, op_input, op_output, context):
            op_output.emit(np.zeros(1), "out")
            self.left = getattr(self, "left", 3) - 1
            if not self.left:
                self.stop_execution()

    class Sink(Operator):
        def setup(self, spec):
            spec.input("in")

        def compute(self, op_input, op_output, context):
            op_input.receive("in")

    class Small(Application):
        def compose(self):
            self.add_flow(Source(self, name="source"), Sink(self, name="sink"), {("out", "in")})

    graph = Small(track=True)
    graph.run()
    measures = graph_measures(graph)
    assert set(measures["operators"]) == {"source", "sink"} and set(measures["paths"]) == {"source,sink"}
    for each in (*measures["paths"].values(), measures["operators"]["sink"]):
        assert sum(each["counts"]) == 3 and len(each["counts"]) == len(BOUNDS_S) + 1 and each["sum_s"] > 0
    assert list(measures["queues"].values()) == [{"queued": 0, "dropped": {}}]


def test_cause_of_maps_exit_descriptions_to_few_causes():
    said = {
        "killed by SIGKILL": "SIGKILL",
        "it has said nothing for 3.1 s; it was killed": "hung",
        "exit code 1": "exit code 1",
        "exit code 2": "refused",
        "it was asked to stop": "ended",
    }
    assert {how: cause_of(how) for how in said} == said


def test_stream_measures_without_streams_have_no_samples():
    assert all(not family.samples for family in StreamMeasures().collect())
