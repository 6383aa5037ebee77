"""Flow tracking: percentiles, paths, reading while running; counts are the same on every engine."""

from __future__ import annotations

import threading
import time

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from operators.graph.tracking import FlowTracker, Histogram


@given(st.lists(st.integers(0, 2**44 - 1), min_size=1, max_size=200))
def test_histogram_percentiles_exceed_exact_by_at_most_one_bucket(durations):
    histogram = Histogram()
    for duration in durations:
        histogram.record(duration)
    summary = histogram.summary()
    assert summary.count == len(durations)
    assert summary.max_ms == max(durations) * 1e-6
    for fraction, found_ms in ((0.5, summary.p50_ms), (0.95, summary.p95_ms), (0.99, summary.p99_ms)):
        exact_ms = float(np.quantile(durations, fraction, method="inverted_cdf")) * 1e-6
        assert exact_ms * (1 - 1e-12) <= found_ms <= exact_ms * (1 + 1 / 32) + 1e-12


def test_histogram_quantile_rank_is_not_rounded_up():
    # Up to 63 every duration has its own bucket; in floats 0.07 * 100 and 0.55 * 20 are above 7 and 11.
    for count in (20, 25, 50):
        histogram = Histogram()
        for duration in range(1, count + 1):
            histogram.record(duration)
        found = histogram.quantiles_ms([k / count for k in range(1, count + 1)])
        np.testing.assert_allclose(found, np.arange(1, count + 1) * 1e-6, rtol=1e-12)


def test_histogram_clamps_durations_beyond_range():
    histogram = Histogram()
    histogram.record(2**60)
    histogram.record(-5)
    assert histogram.summary().count == 2 and histogram.summary().max_ms == 2**60 * 1e-6


@given(
    st.lists(st.integers(0, 10**10), max_size=100),
    st.lists(st.integers(0, 10**10), min_size=1, max_size=9, unique=True),
)
def test_histogram_between_counts_each_duration_once(durations, bounds):
    histogram, bounds = Histogram(), sorted(bounds)
    for duration in durations:
        histogram.record(duration)
    found = histogram.between(bounds)
    assert len(found) == len(bounds) + 1 and sum(found) == len(durations) and histogram.sum_ns == sum(durations)
    for bound, below in zip(bounds, np.cumsum(found), strict=False):
        # Those above the bound in the bucket that it cuts are counted below it, and no others.
        assert (
            sum(each <= bound for each in durations) <= below <= sum(each <= bound * (1 + 1 / 32) for each in durations)
        )


def test_empty_histogram_summary_is_zero():
    assert Histogram().summary().count == 0 and Histogram().summary().p99_ms == 0.0


def diamond(kit, app, count):
    source, join, sink = (
        app.counted(count, kit.Source, name="src"),
        kit.Join(app, name="join"),
        kit.Collect(app, name="sink"),
    )
    left, right = kit.Apply(app, name="depth"), kit.Apply(app, name="mask")
    left.function = lambda value: time.sleep(0.002) or value
    app.add_flow(source, left)
    app.add_flow(source, right)
    app.add_flow(left, join, {("out", "left")})
    app.add_flow(right, join, {("out", "right")})
    app.add_flow(join, sink)
    app.add_flow(source, kit.Collect(app, name="raw"))


def test_tracker_has_latency_of_every_path_from_root_to_leaf(kit, runner):
    app = kit.Wired(lambda app: diamond(kit, app, 12), track=True)
    for _ in range(2):  # begins anew with each run
        runner(app)
        latency, compute = app.track().latency(), app.track().compute()
        assert {path: summary.count for path, summary in latency.items()} == {
            "src,depth,join,sink": 12,
            "src,mask,join,sink": 12,
            "src,raw": 12,
        }
        assert {name: summary.count for name, summary in compute.items()} == app.result.computes
        # Both ways wait for the slower branch at the join.
        assert min(latency["src,depth,join,sink"].p50_ms, latency["src,mask,join,sink"].p50_ms) >= 2.0
        assert 2.0 <= compute["depth"].p50_ms <= compute["depth"].p99_ms <= compute["depth"].max_ms


def test_flow_tracker_is_readable_during_run(kit, runner):
    passed, go_on = threading.Event(), threading.Event()

    def pause(value):
        if value == 5:
            passed.set()
            assert go_on.wait(300)

    def wire(app):
        app.chain(app.counted(9, kit.Source, name="src"), kit.Collect(app, name="sink", function=pause))

    app = kit.Wired(wire)
    tracker = app.track()
    thread, outcome = runner.in_background(app)
    assert passed.wait(300)
    assert app.result is None
    assert tracker.latency()["src,sink"].count == 5
    assert tracker.compute()["sink"].count == 5
    (edge,) = app.edge_stats()
    assert (edge.edge, edge.received) == ("src.out -> sink.in", 6)
    go_on.set()
    thread.join(300)
    assert outcome and outcome[0] is app.result
    assert tracker.latency()["src,sink"].count == 9


def test_tracker_is_empty_if_tracking_is_off(kit, greedy_runner):
    app = kit.Wired(lambda app: app.chain(app.counted(3, kit.Source), kit.Collect(app)))
    greedy_runner(app)
    assert app.track().latency() == {} == app.track().compute()


def test_tracker_extend_keeps_oldest_origin_and_ends_loops():
    tracker = FlowTracker()
    old, new = tracker.begin("src", 100), tracker.begin("src", 200)
    ((node, began_ns),) = tracker.extend("join", [new, old])
    assert (node.names, began_ns) == (("src", "join"), 100)
    assert tracker.extend("src", [((node, began_ns),)]) == ()


def test_tracker_limits_paths_of_chained_diamonds_to_64():
    tracker, trails = FlowTracker(), []
    trail = tracker.begin("src", 0)
    for depth in range(40):
        trails = [tracker.extend(f"{side}{depth}", [trail]) for side in "ab"]
        trail = tracker.extend(f"join{depth}", trails)
    assert len(trail) == 64


def test_histogram_sums_durations_and_counts_between_bounds():
    histogram = Histogram()
    for duration in (-4, 0, 10, 20, 20, 63, 2**44, 2**50):
        histogram.record(duration)
    assert histogram.sum_ns == 10 + 20 + 20 + 63 + 2**44 + 2**50
    assert histogram.between([10, 20, 62, 63, 2**60]) == [3, 2, 0, 1, 2, 0]
    assert histogram.between([]) == [8]
    assert histogram.quantiles_ms((0.25, 0.5, 1.0)) == [0.0, 20 * 1e-6, (2**44 - 1) * 1e-6]


def test_histogram_bucket_width_is_one_32nd_of_octave():
    for duration, end in (
        (63, 63),
        (64, 65),
        (65, 65),
        (66, 67),
        (128, 131),
        (131, 131),
        (132, 135),
        (2**20, 2**20 + 2**15 - 1),
    ):
        histogram = Histogram()
        histogram.record(duration)
        histogram.record(2**40)
        assert histogram.quantiles_ms((0.5,)) == [end * 1e-6]


def test_tracker_finish_counts_each_path_and_no_loop():
    tracker = FlowTracker()
    root = tracker.begin("source", 5)
    assert tracker.begin("source", 7)[0][0] is root[0][0]
    tracker.finish("sink", [root, tracker.begin("source", 7), tracker.begin("sink", 1)])
    assert {path: summary.count for path, summary in tracker.latency().items()} == {"source,sink": 2}
    tracker.reset()
    assert tracker.paths() == {} == tracker.operators()


def test_tracker_latency_quantiles_are_given_by_path():
    tracker = FlowTracker()
    tracker.finish("sink", [tracker.begin("source", 0)])
    ((path, values),) = tracker.latency_quantiles_ms((0.5, 1.0)).items()
    assert path == "source,sink" and len(values) == 2 and 0 < values[0] <= values[1]
    tracker.operator("a").record(2_000_000)
    assert tracker.compute()["a"].max_ms == 2.0 and tracker.operator("a") is tracker.operators()["a"]
