"""Engine process of a stream, `python -m services.supervisor.engine --spec FILE [--again]`.

The engine reconstructs the stream at full or reduced size, reports counters and latencies in its heartbeats, and writes
snapshots of its model on command.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gsplat_core.errors import UserError
from gsplat_core.io.bundle import save_bundle
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.renderer import check_renderer
from gsplat_core.transfers import StagedCopies
from operators.applications.limits import check_picture
from operators.applications.live import LiveParts, live_graph, low_latency, measured_size, new_parts, warm_up
from operators.applications.live_settings import LiveSettings
from operators.applications.session import Session, check_device
from operators.applications.working_size import WorkingSize, trial_run
from operators.errors import SourceUnavailable
from operators.graph.application import Application
from operators.graph.tracking import Histogram
from operators.messages import ShownPicture
from operators.metrics import ScoredFrame
from operators.pipeline import Pipeline
from operators.reconstruct import ReconstructOp
from operators.settings import EngineOptions, check_option
from operators.sources.source import SourceDescription
from services.bus.messages import BOUNDS_S, PicturePublisher, text_of
from services.bus.runtime import StreamFolder, read_json, write_json
from services.errors import BadMessage, CommandRefused
from services.private_files import keep_files_private
from services.supervisor.capture import CapturedSource
from services.supervisor.launcher import NO_USE
from services.supervisor.model_show import ModelShow
from services.supervisor.screen import Layers, LayerScene, Screen, header_of
from services.supervisor.worker import ENGINE_ON_CPU, EngineSpec, ProcessSpec, Worker, scratch_folder, step_back

SHARE_OF_INTERVAL = 0.5
"""Largest share of the frame interval that processing one frame may take without viewers. Viewers,
commands and the capture process share the same cores."""


def engine_scale(
    spec: EngineSpec, about: SourceDescription, kept: Path, measure: Callable[[SourceDescription, float], WorkingSize]
) -> float:
    """Return the scale of a stream's pictures for reconstruction.

    Without the option `engine_scale`, an engine on a CPU measures the largest size that keeps up with the stream. A
    restarted engine reads the stored result, to show its first picture sooner. It measures again if the size or frame
    rate of the pictures has changed. An engine on a GPU uses scale 1.

    Args:
        spec: engine part of the stream specification.
        about: description of the stream's pictures.
        kept: file that stores the measured size. An invalid file is overwritten.
        measure: returns the largest size that needs at most the given share of the frame interval.
    """
    if spec.engine_scale is not None:
        return spec.engine_scale
    if spec.device != "cpu":
        return 1.0
    size = [about.width_px, about.height_px, about.fps]
    try:
        found = read_json(kept)
        scale = float(found["scale"])
        check_option("scale", scale)
        if found["size"] == size and scale <= 1:
            return scale
    except (OSError, BadMessage, UserError, KeyError, TypeError, ValueError):
        pass  # no stored size, or a damaged file: measure
    chosen = measure(about, SHARE_OF_INTERVAL)
    write_json(kept, {"size": size, "scale": chosen.scale, "frame_ms": round(1e3 * chosen.frame_s, 1)})
    return chosen.scale


def scene_of(shown: ShownPicture, newest: Model | Snapshot | None) -> LayerScene | None:
    """Return the scene for drawing layers: the newest model at the live picture's time and camera. None
    without a model, or if model and picture differ in size because a new scene has begun."""
    rendered = shown.rendered
    frame = rendered.frame
    if newest is None or (newest.camera.width_px, newest.camera.height_px) != (frame.width_px, frame.height_px):
        return None
    camera = newest.camera if frame.pose is None else newest.camera.with_pose(frame.pose)
    header = {**header_of(shown), "show": "live", "model_version": newest.version}
    planes = rendered.depth, rendered.alpha
    return LayerScene(newest, camera, frame.time_s, header, metric=frame.depth_is_metric, planes=planes)


BOUNDS_NS = tuple(round(bound_s * 1e9) for bound_s in BOUNDS_S)


def graph_measures(graph: Application) -> dict[str, Any]:
    """Return path latencies, operator durations, and queue lengths and drops of a graph."""
    tracker = graph.track()
    return {
        "paths": {name: _serialised(histogram) for name, histogram in tracker.paths().items()},
        "operators": {name: _serialised(histogram) for name, histogram in tracker.operators().items()},
        "queues": {stats.edge: {"queued": stats.queued, "dropped": stats.dropped} for stats in graph.edge_stats()},
    }


def _serialised(histogram: Histogram) -> dict[str, Any]:
    """Return a histogram in the format of `services.bus.messages.Durations`."""
    return {"counts": histogram.between(BOUNDS_NS), "sum_s": round(histogram.sum_ns * 1e-9, 6)}


WAIT_S = 5.0
"""Seconds that a snapshot waits for training on the next frame."""


class LiveSnapshots:
    """Handler of the command `snapshot`: writes the model of the running reconstruction.

    Snapshots do not delay pictures. The model is copied after a frame's picture is published, and
    written in the command thread in pieces, so that other threads can run.
    """

    def __init__(self) -> None:
        self._graph: Pipeline | None = None
        self._copies: StagedCopies | None = None

    @contextmanager
    def of(self, graph: Pipeline) -> Iterator[None]:
        """Use `graph` as the running reconstruction while the block runs."""
        self._graph = graph
        try:
            yield
        finally:
            self._graph = None

    def take(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `snapshot {folder}`: write the model into a new folder.

        Args:
            arguments: arguments of the command.

        Returns:
            Header of the snapshot: sequence number, model version, Gaussian count and timings.

        Raises:
            BadMessage: if the folder is missing.
            BundleError: if the bundle cannot be written.
            CommandRefused: if no reconstruction runs or no frame arrives.
        """
        folder = Path(text_of(arguments, "folder"))
        running: ReconstructOp | None = getattr(self._graph, "reconstruct", None)
        if running is None:
            raise CommandRefused("no live reconstruction runs; what is shown is a finished model, or nothing yet")
        model, seq, pause_ns = self._asked(running)
        began_s = time.monotonic()
        self._write(model, folder)
        return {
            "seq": seq,
            "model_version": model.version,
            "gaussians": model.gaussians.count,
            "time_window_s": list(model.time_window_s),
            "pause_ms": round(pause_ns * 1e-6, 3),
            "written_ms": round((time.monotonic() - began_s) * 1e3, 3),
        }

    def _asked(self, running: ReconstructOp) -> tuple[Model, int, int]:
        """Request the model that the next frame is trained into, and copy it.

        The GPU snapshot is released here, because training needs another slot while one is held.

        Returns:
            A copy of the model, the frame's sequence number and the pause of the training in nanoseconds.
        """
        request = running.request_model()
        answer = request.wait(WAIT_S)
        if answer is None:
            why = request.refused or f"no frame has come for {WAIT_S:g} s"
            raise CommandRefused(f"there is no model to write: {why}")
        return self._copied(answer.model), answer.frame.seq, answer.pause_ns

    def _copied(self, model: Model | Snapshot) -> Model:
        """Copy the model. On a GPU, use a separate stream that waits only for the model's tensors."""
        if model.device.type != "cuda":
            return model.as_model()
        if self._copies is None:
            self._copies = StagedCopies(model.device)
        stream = self._copies.stream
        with torch.cuda.stream(stream):
            if isinstance(model, Model):
                stream.wait_stream(torch.cuda.default_stream(model.device))
            return model.as_model()

    def _write(self, model: Model, folder: Path) -> None:
        if self._copies is None:
            save_bundle(model, folder)
        else:
            with torch.cuda.stream(self._copies.stream):
                save_bundle(model, folder, to_host=self._copies.to_host)


LOOK_S = 0.05
"""Seconds between two checks for a switch back to the live reconstruction, while a finished model is displayed."""


def live_settings(spec: EngineSpec, out: Path, source: str) -> LiveSettings:
    """Return the settings of a live session without end, with every output disabled that grows with time.

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
    trial_run(settings, source, lambda made_up, tried: live_graph(made_up, tried, new_parts(tried, source)))
    return warm_up(settings, source)


def reconstruct(
    worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers, snapshots: LiveSnapshots, *, again: bool
) -> None:
    """Reconstruct live until a stop or the display of a finished model is requested.

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

        def scored(graph: Pipeline, score: ScoredFrame) -> None:
            screen.scored(score)

        def show(shown: ShownPicture) -> None:
            if screen.show(shown):
                layers.offer(lambda: scene_of(shown, graph.reconstruct.newest))

        graph = live_graph(source, settings, parts, stop_requested=stop_requested, on_scored=scored, on_shown=show)
        worker.tell_figures("graph", lambda: graph_figures(graph))
        worker.tell_measures("graph", lambda: graph_measures(graph))
        worker.say("running", "reconstructs")
        with snapshots.of(graph):
            Session(graph, settings.stated(), command="live", stop_requested=stop_requested).execute()
        worker.tell_figures("graph", dict)
        worker.tell_measures("graph", dict)


def show(worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers, again: bool) -> None:
    """Run the live reconstruction, or wait while a finished model is displayed, until a stop is requested."""
    check_device(spec.device)
    check_renderer(spec.renderer, spec.device, options=spec.renderer_options)
    models = ModelShow(worker, spec, screen, layers)
    worker.tell_figures("screen", lambda: {**screen.figures(), **models.figures(), **layers.figures()})
    worker.tell_measures("screen", lambda: {"ages": screen.ages.as_json()})
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


def graph_figures(graph: Pipeline) -> dict[str, object]:
    """Return counts of frames and steps, number of Gaussians and source state of a graph by name; empty before it runs."""
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
        "withheld_now": dict(counts.withheld_now),
        "gaussians": graph.reconstruct.newest_gaussians,
        "source": source.state.value,
        "source_counts": dict(source.counts()) if isinstance(source, CapturedSource) else {},
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the engine process until a stop is requested. Return the exit code: 0, or `NO_USE` after a UserError."""
    keep_files_private()
    parser = argparse.ArgumentParser(description="Engine process of a stream.")
    parser.add_argument("--spec", required=True, help="file with the specification")
    parser.add_argument(
        "--again", action="store_true", help="restart of an engine: display a picture as soon as possible"
    )
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    try:
        path = Path(os.path.abspath(given.spec))
        spec = ProcessSpec.read(path, "engine")
        assert spec.engine is not None
        folder = StreamFolder(path.parent)
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
