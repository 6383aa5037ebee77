"""The audit log over the API: search, pages, export, and the entries written for reads and exports."""

from __future__ import annotations

import csv
import io
import json
from datetime import UTC, datetime, timedelta

import pytest

from services.audit import AuditLog, Keeping, Wanted, exported, reading, search, verify


@pytest.fixture
def filled_plane(plane):
    """A server whose log holds 40 activations of two models and one refused key revocation."""
    audit = plane.control.audit
    for number in range(40):
        audit.append("model.activate", actor=f"console (1f{number % 2})", role="operator", subject=f"liver/{number}")
    audit.append("model.rollback", actor="system", subject="liver", outcome="failed")
    audit.append("key.revoke", actor="shell", subject="1f0", outcome="refused", detail={"error": "KeyConflict", "n": 3})
    audit.append("modelling.start", actor="+cmd", subject="=1+1")
    return plane


def search_audit(plane, **query):
    answer = plane.ask("GET", "/v1/audit", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.parametrize(
    ("query", "events"),
    [
        ({"event": "key.revoke"}, {"key.revoke"}),
        ({"event": "model"}, {"model.activate", "model.rollback"}),
        ({"event": "model."}, {"model.activate", "model.rollback"}),
        ({"event": "model.act"}, set()),
        ({"outcome": "refused"}, {"key.revoke"}),
        ({"outcome": "failed", "actor": "SYSTEM"}, {"model.rollback"}),
        ({"actor": "1f1"}, {"model.activate"}),
        ({"subject": "liver/3", "actor": "console (1f1)"}, {"model.activate"}),
        ({"subject": "spleen"}, set()),
    ],
)
def test_audit_search_returns_only_matching_entries(filled_plane, query, events):
    entries = [
        entry
        for entry in search_audit(filled_plane, count=500, **query)["entries"]
        if not entry["event"].startswith("audit.")
    ]
    assert {entry["event"] for entry in entries} == events
    everything = search_audit(filled_plane, count=500)["entries"]
    assert 0 <= len(entries) < len(everything)
    assert all(entry in everything for entry in entries)


def test_audit_search_is_bounded_by_since_and_until_with_zone(filled_plane):
    entries = search_audit(filled_plane, count=500, event="model.activate")["entries"]
    assert all(datetime.fromisoformat(entry["at"]).tzinfo is not None for entry in entries)
    at = datetime.fromisoformat(entries[20]["at"])
    later = search_audit(filled_plane, count=500, event="model.activate", since=at.isoformat())["entries"]
    earlier = search_audit(filled_plane, count=500, event="model.activate", until=at.isoformat())["entries"]
    assert later + earlier == entries and entries[20] in later
    zone = (at.astimezone(UTC) + timedelta(hours=2)).replace(tzinfo=None).isoformat() + "+02:00"
    assert search_audit(filled_plane, count=500, event="model.activate", since=zone)["entries"] == later


def test_audit_search_pages_contain_every_entry_once(filled_plane, monkeypatch):
    monkeypatch.setattr(reading, "MOST_EXAMINED", 7)
    seen, before, asked = [], None, 0
    while asked == 0 or before is not None:
        page = search_audit(filled_plane, count=5, actor="1f1", **({} if before is None else {"before": before}))
        seen += [entry["subject"] for entry in page["entries"]]
        before, asked = page["next_before"], asked + 1
    assert seen == [f"liver/{number}" for number in range(39, 0, -2)]
    assert asked > 5, "each page looks at seven entries"


@pytest.mark.parametrize(
    "query",
    [{"outcome": "well"}, {"since": "yesterday"}, {"until": "0.5"}, {"since": "1700000000"}, {"since": "2026-01-01T00:00:00"}, {"actor": ""}, {"actor": "a\nb"}, {"subject": 101 * "a"}, {"event": "<b>"}],
)  # fmt: skip
def test_audit_routes_return_422_for_invalid_filter(filled_plane, query):
    for path in ("/v1/audit", "/v1/audit/export"):
        assert filled_plane.ask("GET", path, params=query).status_code == 422


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ({"count": 1}, 200), ({"count": 500}, 200), ({"count": 0}, 422), ({"count": 501}, 422),
        ({"before": 0}, 200), ({"before": 2**63 - 1}, 200), ({"before": -1}, 422), ({"before": 2**63}, 422),
    ],
)  # fmt: skip
def test_audit_route_limits_count_to_500_and_before_to_64_bits(plane, query, status):
    assert plane.ask("GET", "/v1/audit", params=query).status_code == status


def test_full_audit_export_passes_verification(filled_plane, tmp_path):
    answer = filled_plane.ask("GET", "/v1/audit/export")
    assert 'filename="audit-' in answer.headers["content-disposition"]
    assert answer.headers["content-type"].startswith("application/jsonl")
    file = tmp_path / "copy.jsonl"
    file.write_bytes(answer.content)
    verdict = verify(file)
    assert verdict.entries == filled_plane.control.audit.head.seq + 1
    assert verdict.head == filled_plane.control.audit.head
    (finding,) = verdict.findings  # of the chain nothing is wrong; a copy has no head beside it
    assert "the head file next to the log is missing" in finding.what
    assert json.loads(answer.content.splitlines()[-1])["event"] == "audit.export"


def test_audit_csv_export_escapes_spreadsheet_formulas(filled_plane):
    answer = filled_plane.ask("GET", "/v1/audit/export", params={"format": "csv"})
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [int(row["seq"]) for row in rows] == list(range(len(rows)))
    assert not any(str(cell).startswith(("=", "+", "-", "@")) for row in rows for cell in row.values())
    odd = next(row for row in rows if row["event"] == "modelling.start")
    assert (odd["actor"], odd["subject"]) == ("'+cmd", "'=1+1")
    refused = next(row for row in rows if row["outcome"] == "refused")
    assert json.loads(refused["detail"]) == {"error": "KeyConflict", "n": 3}
    one = filled_plane.ask("GET", "/v1/audit/export", params={"format": "csv", "outcome": "refused"})
    assert len(list(csv.DictReader(io.StringIO(one.text)))) == 1


def test_audit_export_reads_all_segments_of_rotated_log(tmp_path):

    log = AuditLog(tmp_path / "audit.jsonl", Keeping(segment_bytes=2000))
    for number in range(30):
        log.append("model.activate", actor="console", subject=str(number))
    assert len(list(tmp_path.glob("audit.0*.jsonl"))) > 3
    pieces = exported(log.path, Wanted(subject="2"), "csv")
    first = next(pieces)
    assert first.startswith(b"seq,at,event")
    lines = b"".join(pieces).splitlines()
    assert [line.split(b",")[0] for line in lines] == [b"2", b"12", *(str(n).encode() for n in range(20, 30))]
    log.close()


def test_audit_logs_reads_once_per_minute_and_every_export(plane):
    for _ in range(5):
        search_audit(plane)
    search_audit(plane, outcome="refused")
    for _ in range(2):
        plane.ask("GET", "/v1/audit/export", params={"format": "csv"})
    entries = [
        entry for entry in search(plane.control.audit.path, Wanted(), 50).entries if entry.event.startswith("audit.")
    ]
    assert [(entry.event, entry.detail) for entry in reversed(entries)] == [
        ("audit.read", {}),
        ("audit.read", {"outcome": "refused"}),
        ("audit.export", {"format": "csv"}),
        ("audit.export", {"format": "csv"}),
    ]


@pytest.mark.parametrize("form", ["jsonl", "csv"])
def test_audit_export_yields_pieces_of_bounded_size(tmp_path, monkeypatch, form):
    log = AuditLog(tmp_path / "audit.jsonl")
    for number in range(40):
        log.append("model.activate", actor="console", subject=str(number))
    whole = b"".join(exported(log.path, Wanted(), form))
    assert whole.count(b"\n") == 40 + (form == "csv")
    longest = max(map(len, whole.splitlines(keepends=True)))
    monkeypatch.setattr(reading, "PIECE_BYTES", 3 * longest)
    pieces = list(exported(log.path, Wanted(), form))
    log.close()
    assert b"".join(pieces) == whole
    body = pieces[1:] if form == "csv" else pieces
    assert len(body) > 5 and all(3 * longest <= len(piece) < 4 * longest for piece in body[:-1])
    assert all(piece.endswith(b"\n") for piece in pieces) and 0 < len(body[-1]) < 4 * longest
