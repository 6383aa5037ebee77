"""Accepted ranges and defaults of numeric service settings, which installations rely on."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from services import settings

MIB, DAYS, SECONDS = 2**20, 36_600, 366 * 86_400
MOST = 10**15
RANGES = {
    "ServerSettings": {
        "port": (8000, 0, 65_535), "probe_port": (None, 0, 65_535), "drain_s": (10, 0, 600), "takeover_s": (0, 0, 3600),
    },
    "AuthSettings": {"ticket_s": (30, 0.001, 300)},
    "AuditSettings": {
        "segment_bytes": (16 * MIB, 65_536, MOST), "keep_segments": (None, 1, MOST), "keep_days": (None, 0.001, DAYS),
    },
    "LimitSettings": {
        "body_bytes": (MIB, 1024, MOST), "model_bytes": (2048 * MIB, MIB, MOST), "recording_bytes": (16_384 * MIB, MIB, MOST),
        "uploads": (8, 1, 64), "uploads_per_key": (2, 1, 64), "stall_s": (10, 0.001, SECONDS),
        "slowest_bytes_per_s": (4096, 0, MOST), "head_s": (10, 0.001, SECONDS), "requests_per_s": (100, 0.001, MOST),
        "address_requests_per_s": (300, 0.001, MOST), "burst_s": (2, 0.1, 60), "connections": (512, 8, MOST),
        "connections_per_address": (128, 0, MOST), "streams": (16, 1, 1000), "viewers": (100, 1, MOST),
        "viewer_stall_s": (15, 0.001, SECONDS),
    },
    "RecordingSettings": {
        "unpacked_bytes": (65_536 * MIB, MIB, MOST), "keep_days": (None, 0.001, DAYS), "keep_bytes": (None, MIB, MOST),
    },
    "JobSettings": {
        "workers": (1, 1, 256), "threads": (None, 1, 256), "attempts": (5, 1, 100), "lease_s": (15, 2, 3600),
        "keep_days": (None, 0.001, DAYS), "keep_results": (None, 1, MOST),
    },
}  # fmt: skip
"""Default, smallest and largest value by class and field. 0.001 stands for a smallest value of 0 that is excluded."""


@pytest.mark.parametrize(
    ("section", "name"), [(section, name) for section, fields in RANGES.items() for name in fields]
)
def test_number_setting_has_default_and_accepts_only_its_range(section, name):
    kind, (default, least, most) = getattr(settings, section), RANGES[section][name]
    field = kind.model_fields[name]
    assert field.get_default() == default
    others = {"uploads": 64} if name == "uploads_per_key" else {}
    for value in (least, most):
        assert getattr(kind.model_validate({**others, name: value}), name) == value
    below = 0 if least == 0.001 else least - 1 if isinstance(least, int) else 0.99 * least
    for value in (below, most + 1):
        with pytest.raises(ValidationError) as refused:
            kind.model_validate({**others, name: value})
        assert {each["loc"][0] for each in refused.value.errors()} == {name}
