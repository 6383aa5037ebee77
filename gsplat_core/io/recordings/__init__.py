"""Recordings of endoscopic video: reading with calibration and ground truth, validation, and synthesis."""

from gsplat_core.io.recordings.plain_files import Finding, ValidationReport
from gsplat_core.io.recordings.recording import FileRecording, Recording, is_heldout, open_recording, validate_recording
from gsplat_core.io.recordings.synthetic.synthesize import synthesize

__all__ = [
    "FileRecording",
    "Finding",
    "Recording",
    "ValidationReport",
    "is_heldout",
    "open_recording",
    "synthesize",
    "validate_recording",
]
