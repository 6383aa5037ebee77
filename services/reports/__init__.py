"""Reports of a run: `report.json` for programs and `report.html` for people."""

from services.reports.schema import RunReport

__all__ = ["RunReport"]
