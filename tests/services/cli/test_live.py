"""Settings of `intrasplat live` from its options."""

from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.sessions import WriterOptions
from services.cli.runs import live_settings, recording_kept


def test_recording_kept_without_limits_keeps_everything():
    assert recording_kept(()) == WriterOptions()


@pytest.mark.parametrize(
    ("text", "keep_bytes", "keep_s"),
    [
        ("20GiB", 20 * 2**30, None),
        ("512 mib", 2**29, None),
        ("0.5TiB", 2**39, None),
        ("90min", None, 5400.0),
        ("48h", None, 172_800.0),
        ("1.5d", None, 129_600.0),
    ],
)
def test_recording_kept_parses_size_or_duration(text, keep_bytes, keep_s):
    options = recording_kept((text,))
    assert (options.keep_bytes, options.keep_s, options.with_earlier) == (keep_bytes, keep_s, True)


def test_recording_kept_sets_segments_to_one_eighth_of_limits():
    options = recording_kept(("80MiB", "2min"))
    assert (options.keep_bytes, options.keep_s) == (80 * 2**20, 120.0)
    assert (options.segment_bytes, options.segment_s) == (10 * 2**20, 15.0)


@pytest.mark.parametrize(
    "texts",
    [("",), ("20",), ("GiB",), ("-1h",), ("20GB",), ("1h 2h",), ("1h", "2d"), ("1MiB",), ("0.1min",), ("9" * 400 + "d",), ("nan h",)],
)  # fmt: skip
def test_recording_kept_rejects_malformed_limits(texts):
    with pytest.raises(InvalidSetting, match=r"^record-keep is .*(such as 20GiB or 48h|at least 64MiB, or 1min)$"):
        recording_kept(texts)


def test_live_settings_require_record_for_record_keep(tmp_path):
    with pytest.raises(InvalidSetting, match="give --record"), live_settings("a", tmp_path, False, ("1h",)):
        pass
    with live_settings("a", tmp_path, True, ("1h",)) as settings:
        assert settings.recording.keep_s == 3600 and settings.record is not None
