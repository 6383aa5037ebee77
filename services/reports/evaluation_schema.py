"""The shape of `evaluation.json`: one model that writes it, reads it back and gives its JSON schema.

Fields are added, never renamed or removed, as long as `format_version` stays. A measure that does not exist is null, never NaN.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from gsplat_core.io.files import read_regular
from operators.storage import write_whole
from services.reports.schema import MOST_REPORT_BYTES, NOTICE, Count, ModelFacts, Part, RecordingFacts

Decibels = float | None
Seconds = tuple[float, float]
"""First and last time of a range."""


class ScoreFacts(Part):
    """Means over frames; PSNR is averaged in decibels."""

    psnr_tissue_db: Decibels
    psnr_frame_db: Decibels
    ssim: float | None
    frames: Count
    worst_db: Decibels
    worst_seq: int | None
    left_out: dict[str, Count]
    """Frames that were not scored, by reason."""


class BaselineFacts(Part):
    """What one trivial baseline scores on the same recording."""

    name: str
    label: str
    frames_of: Literal["every", "heldout", "last", "live", "settled", "second_eye"]
    """Which frames it is scored on: every one that has it, the held-out ones, the last seconds, those that the live figures are of,
    those whose right view is scored."""
    psnr_tissue_db: Decibels
    psnr_frame_db: Decibels
    frames: Count
    age_frames: int | None = None
    """Of copies: how many frames old they are."""
    psnr_both_db: Decibels = None
    """Of copies: over pixels that are tissue in the frame and in the copy."""
    sees_future: bool = False
    """It needs the frame after the one that is shown, which a live system does not have."""


class DepthFacts(Part):
    mae_mm: float
    rmse_mm: float
    relative: float
    scaled_rmse_mm: float
    covered: float
    frames: Count


class HeldOutFacts(Part):
    score: ScoreFacts
    unrounded_db: Decibels
    """Mean tissue PSNR of the pictures before they are rounded to 8 bits."""
    depth: DepthFacts | None


class CausalFacts(Part):
    score: ScoreFacts
    field: str
    steps_per_frame: int
    seed: int
    motion_prior: str


class AgeFacts(Part):
    count: Count
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class OnScreenFacts(Part):
    score: ScoreFacts
    settled: ScoreFacts
    """Without the first second."""
    age_when_shown: AgeFacts | None
    age_on_screen: AgeFacts | None
    in_time: Count
    behind: dict[int, Count]
    states: dict[str, Count]


class PlaceFacts(Part):
    first_s: Seconds
    again_s: Seconds
    first: ScoreFacts
    again: ScoreFacts


class RetentionFacts(Part):
    last: ScoreFacts
    last_range_s: Seconds
    places: list[PlaceFacts]


class DepthShareFacts(Part):
    """Over all compared frames; shares are of the median true depth."""

    rmse_share: float
    scaled_rmse_share: float
    """After the model's depth was multiplied by `scale`: of its shape alone, relative."""
    plane_rmse_share: float
    """Of each frame's best-fit plane."""
    level_rmse_share: float
    """Of each frame's level plane, at the median true depth."""
    median_share: float
    rmse: float
    """In the unit of the recording's depth, mm where it has a scale."""
    scale: float
    median_depth: float
    covered: float
    frames: Count


class NormalFacts(Part):
    mean_deg: float
    median_deg: float
    plane_mean_deg: float
    level_mean_deg: float | None = None
    """None in reports that were written before it was measured."""
    frames: Count


class ViewFacts(Part):
    """A view from where training did not look; over the pixels of tissue that training saw from its own camera."""

    name: str
    model: ScoreFacts
    left: ScoreFacts
    """The left picture, shown as it is."""
    shifted: ScoreFacts
    """The left picture, shifted by the median disparity."""
    seen: float


class TrackFacts(Part):
    median_mm: float
    mean_mm: float
    median_px: float
    mean_px: float
    within_mm: float
    within_px: float


class TrackingFacts(Part):
    """Points of the tissue, followed: errors in the left camera's coordinates, and in pixels of the evaluated pictures."""

    model: TrackFacts
    scaled: TrackFacts
    """After the one factor of the sequence's depth: relative."""
    still: TrackFacts
    """No motion."""
    points: Count
    compared: Count


class EndPointFacts(Part):
    median_px: float
    mean_px: float
    median_mm: float | None
    """Null where the recording knows no scene flow."""
    mean_mm: float | None


class FlowFacts(Part):
    """Where what a pixel shows goes until the next frame: distances from where it truly goes, in the picture and in space."""

    model: EndPointFacts
    scaled: EndPointFacts
    """After the one factor of the sequence's depth: relative."""
    still: EndPointFacts
    """No motion."""
    frames: Count


class TrajectoryFacts(Part):
    """Absolute trajectory error, as a share of the true path."""

    rigid_share: float
    similarity_share: float
    """After the best scale: relative."""
    still_share: float
    rigid_rmse: float
    rotation_deg: float
    scale: float
    path: float
    frames: Count


class PartFacts(Part):
    """Shares of the squared change of the pictures that each part of the deformation explains."""

    motion: float
    colour: float
    size: float
    explained: float
    reference_s: float
    frames: Count


class GeometryFacts(Part):
    """How true the model is in three dimensions; null or empty where the recording does not know the truth."""

    frames: Count
    depth: DepthShareFacts | None
    normals: NormalFacts | None
    views: list[ViewFacts]
    scaled_views: list[ViewFacts]
    """After the one factor of the sequence's depth: relative."""
    tracking: TrackingFacts | None
    flow: FlowFacts | None = None
    trajectory: TrajectoryFacts | None
    parts: PartFacts | None


class SecondEyeFacts(Part):
    score: ScoreFacts
    """`psnr_tissue_db` after a straight line for each channel, over what both eyes see."""
    left_out_px: Count
    """Columns at the right edge that were left out: only the right eye sees them."""


class ReturnFacts(Part):
    """How soon a place was found again."""

    again_s: Seconds
    first_db: list[Decibels]
    frames_until_found: int | None


class EvaluatedFacts(Part):
    """What was evaluated, and how."""

    path: str
    """As it was given."""
    command: str | None
    """What made the model; null where nothing says so."""
    model: ModelFacts
    time_window_s: Seconds
    scale: float
    device: str
    renderer: str
    version: str
    started_at: str
    wall_s: float
    interrupted: bool
    machine: dict[str, str]


class EvaluationReport(Part):
    """Everything `evaluation.json` holds; null for a protocol that was not measured."""

    format_version: Literal[1] = 1
    notice: str = NOTICE
    recording: RecordingFacts
    evaluated: EvaluatedFacts
    heldout: HeldOutFacts | None
    causal: CausalFacts | None
    live: OnScreenFacts | None
    retention: RetentionFacts | None
    geometry: GeometryFacts | None = None
    second_eye: SecondEyeFacts | None = None
    returns: dict[str, list[ReturnFacts]]
    """By protocol."""
    baselines: list[BaselineFacts]
    left_out: dict[str, Count]
    """Frames that no baseline was scored on, by reason."""
    notes: list[str]
    outputs: dict[str, str]
    """What was written, as paths relative to this file."""
    series: dict[str, list[dict[str, float | int | bool | str | None]]]
    """By protocol, one entry for each scored frame; of more than 4096 frames, one for each `series_frames_per_entry` of them."""
    series_frames_per_entry: dict[str, Annotated[int, Field(ge=1)]]

    def write(self, path: Path) -> None:
        """Write JSON; the file is whole or not there."""
        text = json.dumps(self.model_dump(mode="json"), indent=2, allow_nan=False)
        write_whole(path, (text + "\n").encode())

    @classmethod
    def read(cls, path: Path) -> EvaluationReport:
        """Read a report back. Raises pydantic.ValidationError where it does not fit, OSError for anything but a plain file of at most MOST_REPORT_BYTES."""
        return cls.model_validate_json(read_regular(path, MOST_REPORT_BYTES))
