"""Reports of runs (`report.json`, `report.html`) and of evaluations (`evaluation.json`, `evaluation.html`): JSON for programs, HTML
for people."""

from services.reports.schema import RunReport

__all__ = ["RunReport"]
