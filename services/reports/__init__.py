"""What a run leaves for people and programs: `report.json` and `report.html`."""

from services.reports.schema import RunReport

__all__ = ["RunReport"]
