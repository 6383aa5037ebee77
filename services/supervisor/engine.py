"""Engine process of a stream, `python -m services.supervisor.engine --spec FILE [--again]`.

The engine reconstructs the stream at full or reduced size, reports counters and latencies in its heartbeats, and writes
snapshots of its model on command. The commands `show_model`, `show_live` and `show_previous` display a finished model in place of the reconstruction.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsplat_core.errors import InvalidInput, UserError
from gsplat_core.io.bundle import load_bundle, save_bundle
from gsplat_core.models import Model, Snapshot
from gsplat_core.rendering.renderer import RendererOptions, check_renderer, new_renderer
from gsplat_core.scene.frames import Frame
from gsplat_core.transfers import StagedCopies
from operators.applications.limits import check_picture
from operators.applications.live import LiveParts, live_graph, low_latency, measured_size, new_parts, warm_up
from operators.applications.live_settings import LiveSettings
from operators.applications.session import Session, check_device
from operators.applications.working_size import WorkingSize, trial_run
from operators.errors import SourceUnavailable
from operators.graph.application import Application
from operators.graph.tracking import Histogram
from operators.messages import PictureState, ShownPicture
from operators.metrics import ScoredFrame
from operators.pipeline import Pipeline
from operators.rasterize import displayed
from operators.reconstruct import ReconstructOp
from operators.settings import EngineOptions, check_option
from operators.sources.source import SourceDescription, SourceState
from services.bus.messages import BOUNDS_S, PicturePublisher, text_of
from services.bus.runtime import StreamFolder, read_json, write_json
from services.errors import BadMessage, BusError, CommandRefused
from services.private_files import keep_files_private
from services.supervisor.capture import CapturedSource
from services.supervisor.launcher import NO_USE
from services.supervisor.screen import SCORES, Layers, LayerScene, Screen, header_of
from services.supervisor.worker import ENGINE_ON_CPU, EngineSpec, ProcessSpec, Worker, scratch_folder, step_back

log = logging.getLogger(__name__)
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
    """Return the scene for drawing layers such as depth: the newest model at the live picture's time and camera. None
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
"""Seconds that the command `snapshot` waits for training on the next frame before it is refused."""


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


class NotFinite(InvalidInput):
    """A rendered picture, or a Gaussian of its model, has non-finite values."""


class FinishedModel:
    """Model from a bundle, with its own renderer. For use by one thread at a time.

    The constructor renders a picture as warm-up.

    Raises:
        BundleError: if the bundle cannot be loaded.
        CommandRefused: if the warm-up picture is not finite.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        version: int,
        *,
        device: str,
        renderer: str,
        options: RendererOptions | None = None,
    ) -> None:
        self.name, self.version = name, version
        self._model = load_bundle(folder).to(device)
        self._camera = self._model.camera
        check_picture(self._camera, 1.0)
        self._renderer = new_renderer(renderer, self._camera, torch.device(device), options=options)
        self._renderer.prepare(self._model)
        try:
            self.picture(0.0)
        except NotFinite as error:
            raise CommandRefused(str(error)) from None

    def at(self, stream_s: float) -> float:
        """Map a stream time to a time in the model's time window, which repeats after its end.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            Model time in seconds.
        """
        start_s, end_s = self._model.time_window_s
        return start_s + math.fmod(max(0.0, stream_s), end_s - start_s) if end_s > start_s else start_s

    def scene(self, stream_s: float, header: Mapping[str, Any]) -> LayerScene:
        """Return the scene at a stream time for the layer pictures. Not metric, because bundles state no unit."""
        return LayerScene(self._model, self._camera, self.at(stream_s), header)

    def picture(self, stream_s: float) -> NDArray[np.uint8]:
        """Render the model through its own camera.

        Args:
            stream_s: time of the stream in seconds.

        Returns:
            RGB uint8 [H, W, 3].

        Raises:
            NotFinite: if the picture or the Gaussians have non-finite values.
        """
        time_s = self.at(stream_s)
        with torch.inference_mode():
            image = self._renderer.render(self._camera, time_s, ("image",)).result().image
            # The renderer skips non-finite Gaussians, so the picture alone would not show them.
            drawn = (image, *self._model.at(time_s).tensors().values())
            if not all(bool(torch.isfinite(values).all()) for values in drawn):
                raise NotFinite(
                    f"{self.name} {self.version} has values that are not finite at {time_s:.3f} s of its time"
                )
            return displayed(image).copy()


MODEL_POLL_S = 0.1
REPEAT_NS = 200_000_000
LATE_IN_A_ROW = 5
"""Consecutive late pictures that count as a missed time limit. A single late picture may be caused by other load on
the machine."""


@dataclass(frozen=True)
class Showing:
    """Displayed model, with the arguments of the command `show_model` that requested it."""

    model: FinishedModel
    asked: Mapping[str, Any]
    """Arguments of the command, stored so that the next engine process can repeat it."""
    most_ms: float | None

    def __str__(self) -> str:
        return f"{self.model.name or 'the model'} {self.model.version}"


class ModelShow:
    """Display thread for finished models. For each arriving frame it renders the selected model at the frame's time.

    A new selection takes effect between two pictures, and the previous model is kept for a rollback. A model with
    non-finite pictures, or with repeatedly more than `most_ms` per picture, is replaced by the previous model or the
    live reconstruction. The selection is stored in a file, so the next engine process restores it.
    """

    def __init__(self, worker: Worker, spec: EngineSpec, screen: Screen, layers: Layers | None = None) -> None:
        self._worker, self._spec, self._screen, self._layers = worker, spec, screen, layers
        self._file = worker.folder.path / "engine.show"
        self._lock = threading.Lock()
        self._changing = threading.Lock()
        self._current: Showing | None = None
        self._previous: Showing | None = None
        self._late = 0
        self._gave_way: list[dict[str, Any]] = []
        """Name, version and reason of the last eight models that this engine stopped displaying after failures."""
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Display the model that the previous engine process displayed, if any; discard its record if it is unusable."""
        try:
            said = read_json(self._file)
            self.show(said)
        except FileNotFoundError:
            return
        except (UserError, BusError) as error:
            log.error("the model that was shown is not shown again: %s", error)
            self._file.unlink()

    def show(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `show_model {folder, version, name?, most_ms?}`: load a model and display it.
        Returns after the model has rendered a picture; on errors the current display is unchanged.

        Args:
            arguments: arguments of the command.

        Returns:
            The version and the preparation time.

        Raises:
            BadMessage: if an argument is not valid.
            BundleError: if the bundle cannot be loaded.
            CommandRefused: if the model renders non-finite values.
        """
        folder, version = text_of(arguments, "folder"), arguments.get("version")
        name, most_ms = arguments.get("name", ""), arguments.get("most_ms")
        if type(version) is not int or version < 1 or not isinstance(name, str):
            raise BadMessage(f"version is {version!r:.40} and name {name!r:.40}; give a whole number and a text")
        if most_ms is not None and not (isinstance(most_ms, int | float) and most_ms > 0):
            raise BadMessage(f"most_ms is {most_ms!r:.40}; give milliseconds, or leave it out")
        with self._changing:
            began_s = time.monotonic()
            model = FinishedModel(
                Path(folder), name, version,
                device=self._spec.device, renderer=self._spec.renderer, options=self._spec.renderer_options,
            )  # fmt: skip
            asked = {"folder": folder, "version": version, "name": name, "most_ms": most_ms}
            with self._lock:
                self._previous = self._current
                self._put(Showing(model, asked, most_ms))
                self._screen.want("model")
                if self._thread is None:
                    self._thread = threading.Thread(target=self._show_models, name="models")
                    self._thread.start()
            return {"version": version, "prepared_s": round(time.monotonic() - began_s, 3)}

    def show_live(self, _: Mapping[str, Any]) -> None:
        """Handle `show_live`: display the live reconstruction from its next picture on."""
        with self._changing, self._lock:
            self._to_live()

    def show_previous(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Handle `show_previous`: display the previous model again.

        Raises:
            CommandRefused: if there is no previous model.
        """
        with self._changing, self._lock:
            if self._current is None or self._previous is None:
                raise CommandRefused("no model was shown before this one")
            before, self._previous = self._previous, self._current
            self._put(before)
            return {"version": before.model.version}

    def figures(self) -> dict[str, Any]:
        """Return the displayed model and recent rollbacks for the heartbeats."""
        with self._lock:
            current = self._current
            shown = None if current is None else {"name": current.model.name, "version": current.model.version}
            return {"model": shown, "gave_way": list(self._gave_way)}

    def close(self) -> None:
        """Wait for the display thread to end. The process must already be stopping."""
        thread = self._thread
        if thread is not None:
            thread.join()

    def _show_models(self) -> None:
        """Render at the time of each frame until the live reconstruction takes over or the process stops."""
        stop = self._worker.stop_requested
        try:
            source = CapturedSource(self._worker.folder, stop)
        except UserError:
            return  # stopped before the source was open
        source.open()
        frame: Frame | None = None
        repeated_ns = 0
        try:
            while not stop():
                came = source.read(MODEL_POLL_S)
                frame, now_ns = came or frame, time.monotonic_ns()
                if frame is None or (came is None and now_ns - repeated_ns < REPEAT_NS):
                    continue
                repeated_ns = now_ns
                if not self._draw(frame, came is not None, source.state) and self._live_has_taken_over():
                    return
        finally:
            source.close()

    def _live_has_taken_over(self) -> bool:
        with self._lock:
            if self._screen.wanted != "live":
                return False
            self._current = self._thread = None
            return True

    def _draw(self, frame: Frame, new: bool, source: SourceState) -> bool:
        """Render and publish one picture.

        Returns:
            False if it was not published.
        """
        with self._lock:
            showing = self._current
        assert showing is not None
        began_ns = time.monotonic_ns()
        try:
            image = showing.model.picture(frame.time_s)
        except NotFinite as error:
            return self._give_way(showing, str(error))
        now_ns = time.monotonic_ns()
        self._check_time(showing, (now_ns - began_ns) * 1e-6)
        age_ns = max(0, now_ns - (frame.arrived_ns or now_ns))
        state = PictureState.LIVE if source is SourceState.LIVE else PictureState.SOURCE_LOST
        header = {
            "seq": frame.seq,
            "pts_ns": frame.pts_ns,
            "arrived_ns": frame.arrived_ns,
            "shown_ns": now_ns,
            "age_ms": round(age_ns * 1e-6, 3),
            "state": state.value,
            "new": new,
            "model": showing.model.name,
            "model_version": showing.model.version,
            "steps": 0,
            **dict.fromkeys(SCORES),
        }
        shown = self._screen.publish("model", header, image)
        if shown and self._layers is not None:
            self._layers.offer(lambda: showing.model.scene(frame.time_s, {**header, "show": "model"}))
        return shown

    def _check_time(self, showing: Showing, took_ms: float) -> None:
        late = showing.most_ms is not None and took_ms > showing.most_ms
        self._late = self._late + 1 if late else 0
        if self._late >= LATE_IN_A_ROW:
            self._give_way(showing, f"{showing} took {took_ms:.1f} ms for a picture, {LATE_IN_A_ROW} times in a row")

    def _give_way(self, showing: Showing, why: str) -> bool:
        """Replace a failed model by the model displayed before it, or by the live reconstruction if there is none.

        The display stays unchanged if a command has already selected another model.

        Args:
            showing: the model that failed.
            why: reason of the failure, for the log and the status.

        Returns:
            True if a model is displayed next, False if the live reconstruction is.
        """
        log.error("%s; what was shown before is shown again", why)
        with self._lock:
            taken_back = {"name": showing.model.name, "version": showing.model.version, "reason": why}
            self._gave_way = [*self._gave_way[-7:], taken_back]
            if self._current is not showing:
                return True  # a command has selected another model since the failed picture
            before, self._previous = self._previous, None
            if before is not None:
                self._put(before)
                return True
            self._to_live()
            return False

    def _put(self, showing: Showing) -> None:
        """Display a model from the next picture on, and store its command for the next engine process. Requires the
        lock."""
        self._current, self._late = showing, 0
        write_json(self._file, showing.asked)

    def _to_live(self) -> None:
        # The model stays on screen until the first live picture. `Screen.publish` then refuses the model's pictures,
        # and the display thread ends.
        self._screen.want("live")
        self._previous = None
        self._file.unlink(missing_ok=True)


POLL_S = 0.05
"""Seconds between two checks for a switch back to the live reconstruction, while a finished model is displayed."""


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
                worker.wait(POLL_S)
    finally:
        if not worker.stop_requested():
            worker.request_stop("the engine failed")
        models.close()
        layers.close()


def graph_figures(graph: Pipeline) -> dict[str, object]:
    """Return counts of frames and optimiser steps, number of Gaussians and source state of a graph by name; empty before it runs."""
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
        log.info("%s", error)
    except UserError as error:
        log.error("%s", error)
        return NO_USE
    return 0


if __name__ == "__main__":
    sys.exit(main())
