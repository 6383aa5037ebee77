"""Live section of the report."""

from __future__ import annotations

from operators.applications.session import RunOutcome
from operators.checks import StageCounts
from operators.display import LiveDisplayResult
from operators.metrics import OnScreenResult
from operators.reconstruct import TrainingCounts
from services.reports.schema import LiveFacts


def live_facts(outcome: RunOutcome) -> LiveFacts | None:
    """Collect the results of a live run's operators; None for other runs."""
    screen, scores = outcome.find(LiveDisplayResult), outcome.find(OnScreenResult)
    training = outcome.find(TrainingCounts)
    if screen is None or scores is None or training is None:
        return None
    age = screen.age
    return LiveFacts(
        settled_psnr_tissue_db=_rounded(scores.settled_db),
        worst_psnr_tissue_db=_rounded(scores.worst_db),
        previous_frame_db=_rounded(scores.previous_frame_db),
        pictures=screen.pictures,
        age_p50_ms=round(age.p50_ms, 2),
        age_p95_ms=round(age.p95_ms, 2),
        age_p99_ms=round(age.p99_ms, 2),
        age_max_ms=round(age.max_ms, 2),
        first_picture_ms=_rounded(screen.first_picture_ms),
        states=screen.states,
        dropped=_passed_over(outcome, training),
        withheld=training.withheld,
        scenes=training.scenes,
        analysis={
            part.name: dict(part.found)
            for part in outcome.parts.values()
            if isinstance(part, StageCounts) and part.found
        },
        frames_trained=training.frames,
        steps=training.steps,
        rehearsed_steps=training.rehearsed,
        unscored=scores.unscored,
        not_on_screen=scores.not_on_screen,
    )


def _passed_over(outcome: RunOutcome, training: TrainingCounts) -> dict[str, int]:
    counts = dict(outcome.dropped_by_edge)
    if training.passed_over:
        counts["reconstruct"] = training.passed_over
    return counts


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
