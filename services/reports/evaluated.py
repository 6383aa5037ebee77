"""Loading of an evaluation target: a model bundle, or a run's folder with its report."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import ValidationError

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.bundle import load_bundle
from gsplat_core.scene.model import Model
from operators.applications.evaluated import EvaluatedRun
from services.reports.schema import RunReport

REPORT, MODEL = "report.json", "model"


def load_evaluated(path: Path) -> tuple[Model, EvaluatedRun | None]:
    """Load the model at `path`, with the report of the run that created it. The report is in the
    run's folder, or next to the bundle if its digest matches.

    Returns:
        The model, and the run or None.

    Raises:
        InvalidSetting: if a run has no model or an unreadable report.
        BundleError: if the model cannot be loaded.
    """
    if os.path.lexists(path / REPORT):
        report = _read(path / REPORT)
        if not (path / MODEL).is_dir():
            raise InvalidSetting(f"{path} is a run that left no model; give another run, or a model folder")
        model = load_bundle(path / MODEL)
        if report.model is not None and report.model.sha256 != model.sha256():
            raise InvalidSetting(
                f"{path / MODEL} is not the model that {path / REPORT} is about (SHA-256 {report.model.sha256[:12]}...); give the model's"
                " folder to evaluate it alone"
            )
        return model, _run(path, report)
    model = load_bundle(path)
    beside = path.absolute().parent / REPORT
    if path.absolute().name == MODEL and os.path.lexists(beside):
        report = _read(beside)
        if report.model is not None and report.model.sha256 == model.sha256():
            return model, _run(beside.parent, report)
    return model, None


def _read(path: Path) -> RunReport:
    try:
        return RunReport.read(path)
    except OSError as error:
        raise InvalidSetting(
            f"{path} cannot be read: {error.strerror or error}; give the model's folder to evaluate it alone"
        ) from error
    except (ValidationError, UnicodeDecodeError, RecursionError) as error:
        said = str(error).splitlines()
        raise InvalidSetting(
            f"{path} is not a report of this version ({' '.join(said[:2])}); give the model's folder to evaluate it alone"
        ) from error


def _run(folder: Path, report: RunReport) -> EvaluatedRun:
    run = report.run
    return EvaluatedRun(
        folder=folder,
        command=run.command,
        field=run.field,
        seed=run.seed,
        steps_per_frame=run.steps_per_frame,
        scale=run.scale,
        heldout=report.quality.heldout is not None,
        eyes=run.eyes,
        fps=report.recording.fps if run.command == "live" else None,
    )
