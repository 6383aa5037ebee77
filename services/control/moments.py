"""Timestamp type for requests: ISO 8601 text with a time zone. Rejects the numbers that pydantic
would accept."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import Annotated

from pydantic import AfterValidator, AwareDatetime, BeforeValidator, Strict

_DATE_AND_TIME = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d.*")


def _text(value: object) -> object:
    if not isinstance(value, str) or not _DATE_AND_TIME.fullmatch(value):
        raise ValueError("it is no date and time with a zone, such as 2026-11-23T20:30:00+01:00")
    return value


def _in_utc(moment: datetime) -> datetime:
    """Convert a timestamp to UTC.

    Raises:
        ValueError: if the result is not in the years 1 to 9999.
    """
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("it is before the year 1 or after the year 9999 in UTC") from error


Moment = Annotated[AwareDatetime, Strict(False), BeforeValidator(_text), AfterValidator(_in_utc)]
