"""Protocols of an evaluation with their baselines, for the page and the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from services.reports.evaluation_schema import BaselineFacts, EvaluationReport, ScoreFacts


@dataclass(frozen=True)
class Measured:
    """Scores of one protocol and its baselines, primary baseline first."""

    key: str
    name: str
    what: str
    """Short description of the displayed pictures."""
    score: ScoreFacts
    baselines: tuple[BaselineFacts, ...]

    @property
    def versus(self) -> tuple[float, BaselineFacts] | None:
        """Return the gain in decibels over the first measured baseline, and that baseline."""
        for baseline in self.baselines:
            if baseline.psnr_tissue_db is not None and self.score.psnr_tissue_db is not None:
                return self.score.psnr_tissue_db - baseline.psnr_tissue_db, baseline
        return None


def measured(report: EvaluationReport) -> list[Measured]:
    """Return the measured protocols, in page order."""

    def named(frames_of: str, *names: str) -> tuple[BaselineFacts, ...]:
        by_name = {each.name: each for each in report.baselines if each.frames_of == frames_of}
        return tuple(by_name[name] for name in names if name in by_name)

    found: list[Measured] = []

    def add(key: str, name: str, what: str, score: ScoreFacts, baselines: tuple[BaselineFacts, ...]) -> None:
        found.append(Measured(key, name, what, score, baselines))

    if (live := report.live) is not None:
        shown = "what was on the screen when the next frame came (training error)"
        add("live", "Live", shown, live.score, named("live", "previous_frame"))
        add(
            "settled",
            "Live, settled",
            "the same without the first second (training error)",
            live.settled,
            named("settled", "previous_frame"),
        )
    if report.causal is not None:
        against = named("every", "half_velocity_flow", "previous_frame")
        add("causal", "Causal", "the next frame, predicted before it was seen", report.causal.score, against)
    if report.heldout is not None:
        against = named("heldout", "half_way_flow", "neighbour_mean", "previous_frame", "train_mean")
        add("heldout", "Held out", "frames that training never saw", report.heldout.score, against)
    if report.second_eye is not None:
        against = named("second_eye", "semi_global_matching", "previous_right", "left_shifted")
        shown = "every tenth frame as the right eye sees the final model, a straight line per channel fitted"
        add("second_eye", "Right eye", shown, report.second_eye.score, against)
    if report.retention is not None:
        start_s, end_s = report.retention.last_range_s
        shown = f"the last {end_s - start_s:.3g} s again, by the final model (training error)"
        add("retention", "Retention", shown, report.retention.last, named("last", "last_frame"))
    return found


def future(baseline: BaselineFacts) -> str:
    """Return the baseline's label, marked if it uses future frames."""
    return f"{baseline.label} (sees the future)" if baseline.sees_future else baseline.label


def decibels(value: float | None) -> str:
    """Format with two decimals; a dash for None."""
    return "–" if value is None else f"{value:.2f}"


def at_age(report: EvaluationReport, age_frames: float) -> float | None:
    """Interpolate the frame-hold curve linearly at an age in frames; None outside the measured
    ages.

    Ages below one frame count as one: a picture that stays until the next frame equals a copy of
    the previous frame.
    """
    copies = sorted(
        (each.age_frames, each.psnr_tissue_db)
        for each in report.baselines
        if each.age_frames is not None and each.psnr_tissue_db is not None
    )
    age_frames = max(1.0, age_frames)
    for (low, low_db), (high, high_db) in pairwise(copies):
        if low <= age_frames <= high:
            return low_db + (high_db - low_db) * (age_frames - low) / (high - low)
    return copies[0][1] if copies and age_frames == copies[0][0] else None
