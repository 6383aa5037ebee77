"""`report.json`: complete, readable, without NaN, with the promised fields."""

from __future__ import annotations

import builtins
import io
import json
import platform

import pytest
from pydantic import ValidationError

from services.reports.schema import BinEntry, FrameEntry, RunReport, processor_name

PROMISED = {
    "recording": {"frames", "width_px", "height_px", "fps"},
    "run": {"device", "engine", "seed", "version", "threads", "wall_s"},
    "frames": {"ingested", "displayed", "dropped"},
    "quality": {"live", "heldout", "baselines"},
    "model": {"gaussians", "parameters", "sha256"},
}


def test_run_report_round_trips_through_json(tmp_path, report):
    report.write(tmp_path / "report.json")
    assert RunReport.read(tmp_path / "report.json") == report
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_run_report_with_binned_series_round_trips(tmp_path, report):
    content = report.model_dump()
    bins = [{**entry, "frames": 3, "psnr_tissue_min_db": 21.5} for entry in content["series"]]
    binned = RunReport.model_validate({**content, "series": bins, "series_frames_per_entry": 3})
    assert {type(entry) for entry in binned.series} == {BinEntry} and {type(entry) for entry in report.series} == {
        FrameEntry
    }
    binned.write(tmp_path / "report.json")
    assert RunReport.read(tmp_path / "report.json") == binned
    with pytest.raises(ValidationError, match="psnr_tissue_min_db"):
        RunReport.model_validate({**content, "series": [{**bins[0], "psnr_tissue_min_db": "low"}]})


def test_run_report_reads_older_reports_without_new_fields(report):
    content = report.model_dump()
    del content["series_frames_per_entry"], content["run"]["renderer"]
    assert RunReport.model_validate(content) == report


def test_report_json_contains_promised_fields(tmp_path, report):
    report.write(tmp_path / "report.json")
    content = json.loads((tmp_path / "report.json").read_text())
    for part, names in PROMISED.items():
        assert names <= set(content[part]), part
    assert set(content["quality"]["live"]) >= {"psnr_tissue_db", "psnr_frame_db", "ssim"}
    assert set(content["quality"]["baselines"]) >= {"previous_frame_db", "train_mean_db"}
    assert set(next(iter(content["latency_ms"].values()))) == {"p50", "p95", "p99", "max"}
    assert set(content["operators"]["source"]) == {"calls", "p50_ms", "p99_ms"}
    assert content["notice"] == "Research use only, not a medical device."


def test_run_report_rejects_nan(report):
    content = report.model_dump()
    content["quality"]["live"]["ssim"] = float("nan")
    with pytest.raises(ValidationError, match="finite"):
        RunReport.model_validate(content)


@pytest.mark.parametrize(("part", "field"), [("run", "wall_s"), ("frames", "dropped"), ("recording", "fps")])
def test_run_report_rejects_missing_field(report, part, field):
    content = report.model_dump()
    del content[part][field]
    with pytest.raises(ValidationError, match=field):
        RunReport.model_validate(content)


def test_run_report_rejects_unknown_field(report):
    with pytest.raises(ValidationError, match="surprise"):
        RunReport.model_validate(report.model_dump() | {"surprise": 1})


def test_run_report_has_json_schema():
    schema = RunReport.model_json_schema()
    assert "frames_sha256" in schema["required"]


@pytest.mark.parametrize(
    ("lines", "processor", "name"),
    [
        ("flags: a\nmodel name\t: A Processor: 3 GHz \nmodel name : B\n", "other", "A Processor: 3 GHz"),
        ("flags: a\n", "other", "other"),
        ("", "", "a machine"),
        (None, "other", "other"),
        (None, "", "a machine"),
    ],
)
def test_processor_name_prefers_model_name_of_cpuinfo(monkeypatch, lines, processor, name):
    def opened(path, **_):
        if lines is None:
            raise FileNotFoundError(path)
        return io.StringIO(lines)

    monkeypatch.setattr(builtins, "open", opened)
    monkeypatch.setattr(platform, "processor", lambda: processor)
    monkeypatch.setattr(platform, "machine", lambda: "a machine")
    found = processor_name()
    monkeypatch.undo()
    assert found == name
