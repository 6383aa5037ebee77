"""Error for a run without displayed frames, with reasons and remedies."""

from __future__ import annotations

from collections import Counter

from operators.applications.session import RunOutcome
from operators.errors import NothingShown
from operators.ingest import SourceResult
from operators.out_of_body import WITHHELD as OUT_OF_BODY
from operators.out_of_body import OutOfBodyFrames
from operators.reconstruct import TrainingCounts
from services.reports.build import displayed

CHECK_PICTURE = "check what the source sends"
REMEDIES = {
    OUT_OF_BODY: "--out-of-body off lets these frames pass",
    "no tissue": "--tool-mask none takes every pixel for tissue",
    "tool mask lost": "--tool-mask none takes every pixel for tissue",
    "damaged": "check the connection, or the file",
    **dict.fromkeys(("black", "one colour", "noise", "duplicate", "frozen", "torn", "out of order"), CHECK_PICTURE),
    **dict.fromkeys(("blur", "smoke", "cut in doubt"), "a longer run shows such a stream after a second or two"),
}
"""Remedy for each reason of withheld frames."""


def require_shown(outcome: RunOutcome) -> None:
    """Check that a run displayed a frame.

    An interrupted run without withheld frames is accepted, because it may have ended before its
    first picture.

    Raises:
        NothingShown: if not; the message has the frame counts, the reasons and the remedy.
    """
    if displayed(outcome):
        return
    source = outcome.find(SourceResult)
    frames = 0 if source is None else source.frames
    live = outcome.command == "live"
    withheld = withheld_frames(outcome)
    if outcome.interrupted and not withheld:
        return
    if source is None or not frames:
        name = "the source" if source is None else source.description.name
        state = source.state_sentence if source is not None and source.state_sentence else outcome.stop_reason
        hint = "check that it is sending, or give more --seconds" if live else "check that it holds frames"
        raise NothingShown(f"nothing was shown: no frame came from {name} in {outcome.wall_s:.1f} s ({state}); {hint}")
    came = f"nothing was shown: {frames} {'frame' if frames == 1 else 'frames'} came"
    if not withheld:
        hint = "give more --seconds, or a smaller --scale" if live else "check the recording"
        raise NothingShown(f"{came}, and the run ended before one was on the screen ({outcome.stop_reason}); {hint}")
    counts = ", ".join(f"{_named(outcome, reason)}: {count}" for reason, count in withheld.most_common())
    if live:
        remedies = "; ".join(dict.fromkeys(REMEDIES.get(reason, CHECK_PICTURE) for reason, _ in withheld.most_common()))
        where = ""
    else:
        remedies, where = "record the stream again with settings that let its frames pass", " when they were recorded"
        if set(withheld) == {"damaged"}:
            remedies, where = REMEDIES["damaged"], ""
    raise NothingShown(f"{came}, {withheld.total()} withheld{where} ({counts}); {remedies}")


def withheld_frames(outcome: RunOutcome) -> Counter[str]:
    """Count a run's withheld frames by reason, from the gates of a live run or from the recording."""
    training, source = outcome.find(TrainingCounts), outcome.find(SourceResult)
    if training is not None:
        return Counter(training.withheld)
    found = Counter() if source is None else Counter(source.withheld)
    if source is not None and source.damaged:
        found["damaged"] = source.damaged
    return found


def _named(outcome: RunOutcome, reason: str) -> str:
    """Return a reason, extended by the main evidence for the out-of-body gate."""
    gate = outcome.find(OutOfBodyFrames)
    if reason != OUT_OF_BODY or gate is None or not gate.withheld:
        return reason
    most = max(gate.withheld, key=lambda evidence: gate.withheld[evidence])
    return f"{reason}, mostly for {most}"
