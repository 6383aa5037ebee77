"""Control messages between a source's process and its reader: both ways, and refused where they are none."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from gsplat_core.io.frame_codec import InvalidMessage
from gsplat_core.scene.cameras import Camera
from operators.sources.address import SourceOptions
from operators.sources.process import finite_counts, message, parsed
from operators.sources.source import SourceDescription

CAMERA = Camera.from_focal(30.0, 3, 2)


@pytest.mark.parametrize("data", [b"", b"{", b"\xff", b"[]", b"3", b"{}", b'{"kind": 3}', b"[" * 200_000])
def test_parsed_refuses_invalid_bytes(data):
    with pytest.raises(InvalidMessage):
        parsed(data)


def test_source_description_and_options_round_trip_as_json():
    about = SourceDescription("cam", 3, 2, 25.0, CAMERA, frozenset({"mask", "depth"}), frame_count=7, notes=("a", "b"))
    assert SourceDescription.from_json(parsed(message("x", about=about.as_json()))["about"]) == about
    options = SourceOptions(scale=0.5, loop=True, waiting=3, stereo="top_bottom")
    assert SourceOptions(**parsed(message("x", options=asdict(options)))["options"]) == options


@pytest.mark.parametrize(
    "change",
    [{"camera": None}, {"camera": {"fx": 1}}, {"notes": 3}, {"more": 1}, {"name": 3}, {"width_px": "3"}, {"fps": 0}],
)
def test_source_description_from_json_refuses_invalid_content(change):
    about = SourceDescription("cam", 3, 2, 25.0, CAMERA)
    for content in (about.as_json() | change, None, [], np.zeros(3)):
        with pytest.raises(InvalidMessage, match="describes no source"):
            SourceDescription.from_json(content)


def test_finite_counts_keeps_integer_counts_only():
    assert finite_counts({"late": 3, "lost": "many", "odd": 1.5}) == {"late": 3}
    assert finite_counts([1]) == {} == finite_counts(None)
