"""The service's log: a line of JSON for each event on standard error, with the number of the request that it belongs to."""

from __future__ import annotations

import json
import logging
from contextvars import ContextVar
from datetime import UTC, datetime

from services.settings.addresses import masked_address
from services.settings.sections import LogSettings

REQUEST_ID: ContextVar[str] = ContextVar("request_id", default="")
_FACTS = "facts"


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON. Line breaks in it are escaped, so that nobody can forge a line; passwords in addresses are masked."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": masked_address(record.getMessage()),
        }
        if REQUEST_ID.get():
            entry["request_id"] = REQUEST_ID.get()
        entry.update(getattr(record, _FACTS, {}))
        if record.exc_info:
            entry["exception"] = masked_address(self.formatException(record.exc_info))
        return json.dumps(entry, ensure_ascii=True, default=str)


def log_to_stderr(settings: LogSettings) -> None:
    """Send every logger of this process to standard error."""
    handler = logging.StreamHandler()
    if settings.format == "json":
        handler.setFormatter(JsonFormatter())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=settings.level.upper(), handlers=[handler], force=True)
    logging.getLogger("uvicorn.access").disabled = True  # it writes addresses with tickets in them
    logging.getLogger("websockets").setLevel(logging.WARNING)


def facts(**values: object) -> dict[str, dict[str, object]]:
    """Fields of a line, as `log.info("…", extra=facts(route="/v1/models"))`."""
    return {_FACTS: values}
