"""`report.json`: whole, readable back, without NaN, with the fields that were promised."""

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


def test_what_is_written_reads_back_equal(tmp_path, report):
    report.write(tmp_path / "report.json")
    assert RunReport.read(tmp_path / "report.json") == report
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_a_long_runs_series_of_bins_reads_back_equal(tmp_path, report):
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


def test_what_earlier_reports_did_not_have_is_not_asked_for(report):
    content = report.model_dump()
    del content["series_frames_per_entry"], content["run"]["renderer"]
    assert RunReport.model_validate(content) == report


def test_every_promised_field_is_there(tmp_path, report):
    report.write(tmp_path / "report.json")
    content = json.loads((tmp_path / "report.json").read_text())
    for part, names in PROMISED.items():
        assert names <= set(content[part]), part
    assert set(content["quality"]["live"]) >= {"psnr_tissue_db", "psnr_frame_db", "ssim"}
    assert set(content["quality"]["baselines"]) >= {"previous_frame_db", "train_mean_db"}
    assert set(next(iter(content["latency_ms"].values()))) == {"p50", "p95", "p99", "max"}
    assert set(content["operators"]["source"]) == {"calls", "p50_ms", "p99_ms"}
    assert content["notice"] == "Research use only, not a medical device."


def test_not_a_number_is_refused(report):
    content = report.model_dump()
    content["quality"]["live"]["ssim"] = float("nan")
    with pytest.raises(ValidationError, match="finite"):
        RunReport.model_validate(content)


@pytest.mark.parametrize(("part", "field"), [("run", "wall_s"), ("frames", "dropped"), ("recording", "fps")])
def test_a_missing_field_is_refused(report, part, field):
    content = report.model_dump()
    del content[part][field]
    with pytest.raises(ValidationError, match=field):
        RunReport.model_validate(content)


def test_an_unknown_field_is_refused(report):
    with pytest.raises(ValidationError, match="surprise"):
        RunReport.model_validate(report.model_dump() | {"surprise": 1})


def test_the_json_schema_can_be_given_out():
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
def test_the_processor_has_its_own_name_if_the_system_knows_it(monkeypatch, lines, processor, name):
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
