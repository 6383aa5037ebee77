"""Engine process of a stream, `python -m services.supervisor.engine --spec FILE [--again]`.

Reconstructs the frames of the stream's capture process live and publishes the rendered pictures.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from gsplat_core.errors import UserError
from gsplat_core.rendering.registry import check_renderer
from operators.applications.device import check_device
from operators.applications.limits import check_picture
from operators.applications.live import LiveApplication, LiveParts, low_latency, measured_size, new_parts, warm_up
from operators.applications.live_settings import LiveSettings
from operators.applications.session import Session
from operators.applications.working_size import WorkingSize, trial_run
from operators.errors import SourceUnavailable
from operators.messages import ShownPicture
from operators.metrics import ScoredFrame
from operators.settings import EngineOptions
from operators.sources.source import SourceDescription
from services.bus.pictures import PicturePublisher
from services.private_files import keep_files_private
from services.supervisor.captured_source import CapturedSource
from services.supervisor.engine_size import engine_scale
from services.supervisor.exit_codes import NO_USE
from services.supervisor.graph_measures import graph_measures
from services.supervisor.layers import Layers
from services.supervisor.live_scene import scene_of
from services.supervisor.live_snapshots import LiveSnapshots
from services.supervisor.model_show import ModelShow
from services.supervisor.priority import ENGINE_ON_CPU, step_back
from services.supervisor.scratch import scratch_folder
from services.supervisor.screen import Screen
from services.supervisor.specs import EngineSpec
from services.supervisor.worker import Worker, stream_folder_of

LOOK_S = 0.05
"""Seconds between checks for a switch back to the live reconstruction."""


def live_settings(spec: EngineSpec, out: Path, source: str) -> LiveSettings:
    """Return settings for an endless live session; no output that grows with time is written.

    Args:
        spec: engine part of the stream specification.
        out: output folder.
        source: name of the source.
    """
    return LiveSettings(
        source=source,
        out=out,
        report=False,
        **spec.options(EngineOptions),
    )


def started(settings: LiveSettings, source: CapturedSource, again: bool) -> LiveParts:
    """Create the components of a live session.

    The first start runs a full trial with synthetic frames to warm up every code path. A restart
    skips the trial, to show a picture sooner.
    """
    if again:
        return new_parts(settings, source)
    trial_run(settings, source, lambda made_up, tried: LiveApplication(made_up, tried, new_parts(tried, source)))
    return warm_up(settings, source)


def reconstruct(
    worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers, snapshots: LiveSnapshots, *, again: bool
) -> None:
    """Reconstruct live until the process is asked to stop or to show a finished model.

    Raises:
        UserError: if the configuration cannot work.
        RunFailed: if an operator of the graph failed.
    """

    def stop_requested() -> bool:
        return worker.stop_requested() or screen.wanted != "live"

    worker.say("starting", "waits for the source to be opened by the capture process")
    with TemporaryDirectory(prefix="run-") as folder, low_latency():

        def measure(about: SourceDescription, share: float) -> WorkingSize:
            worker.say("starting", "measures at which size it keeps up")
            return measured_size(live_settings(spec, Path(folder), about.name), about, share)

        def scale_for(about: SourceDescription) -> float:
            check_picture(about.camera, 1.0)
            return engine_scale(spec, about, worker.folder.engine_size, measure)

        source = CapturedSource(worker.folder, stop_requested, scale_for)
        settings = live_settings(spec, Path(folder), source.description.name)
        worker.say("starting", "prepares the reconstruction")
        parts = started(settings, source, again)

        def scored(graph: LiveApplication, score: ScoredFrame) -> None:
            screen.scored(score)

        def show(shown: ShownPicture) -> None:
            if screen.show(shown):
                layers.offer(lambda: scene_of(shown, graph.reconstruct.newest))

        graph = LiveApplication(source, settings, parts, stop_requested=stop_requested, on_scored=scored, on_shown=show)
        worker.tell_figures("graph", lambda: graph_figures(graph))
        worker.tell_measures("graph", lambda: graph_measures(graph))
        worker.say("running", "reconstructs")
        with snapshots.of(graph):
            Session(graph, settings.stated(), command="live", stop_requested=stop_requested).execute()
        worker.tell_figures("graph", dict)
        worker.tell_measures("graph", dict)


def show(worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers, again: bool) -> None:
    """Alternate between the live reconstruction and finished models until the process is asked to
    stop."""
    check_device(spec.device)
    check_renderer(spec.renderer, spec.device)
    models = ModelShow(worker, spec, screen, layers)
    worker.tell_figures("screen", lambda: {**screen.figures(), **models.figures(), **layers.figures()})
    worker.tell_measures("screen", lambda: {"ages": screen.ages.told()})
    snapshots = LiveSnapshots()
    worker.take({"camera": layers.camera, "snapshot": snapshots.take})
    layers.open()
    try:
        models.begin()
        worker.take({"show_model": models.show, "show_live": models.show_live, "show_previous": models.show_previous})
        while not worker.stop_requested():
            if screen.wanted == "live":
                reconstruct(worker, spec, screen, layers, snapshots, again=again)
                again = True
            else:
                worker.say("running", "shows a finished model")
                worker.wait(LOOK_S)
    finally:
        if not worker.stop_requested():
            worker.request_stop("the engine failed")
        models.close()
        layers.close()


def graph_figures(graph: LiveApplication) -> dict[str, object]:
    """Return the counters of a graph by name; empty before the graph runs."""
    if getattr(graph, "metrics", None) is None:
        return {}
    counts = graph.reconstruct.counts
    source = graph.frame_source
    return {
        "frames": graph.source_op.emitted,
        "trained": counts.frames,
        "steps": counts.steps,
        "passed_over": counts.passed_over,
        "withheld": dict(counts.withheld),
        "gaussians": graph.reconstruct.newest_gaussians,
        "source": source.state.value,
        "source_counts": dict(source.counts()) if isinstance(source, CapturedSource) else {},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until asked to stop.

    Returns:
        The exit code.
    """
    keep_files_private()
    parser = argparse.ArgumentParser(description="Engine process of a stream.")
    parser.add_argument("--spec", required=True, help="file with the specification")
    parser.add_argument("--again", action="store_true", help="an engine of this stream ran before: show a picture soon")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        folder, spec = stream_folder_of(given.spec, "engine")
        assert spec.engine is not None
        if spec.engine.device == "cpu":
            step_back(ENGINE_ON_CPU)
        with scratch_folder(), Worker(folder, spec) as worker:
            publisher = PicturePublisher(folder.pictures("engine"))
            try:
                layers = Layers(folder, spec.engine.device)
                show(worker, spec.engine, Screen(publisher), layers, given.again)
            finally:
                publisher.close()
    except SourceUnavailable as error:  # stop requested before the source was open; a restart may succeed
        logging.getLogger(__name__).info("%s", error)
    except UserError as error:
        logging.getLogger(__name__).error("%s", error)
        return NO_USE
    return 0


if __name__ == "__main__":
    sys.exit(main())
