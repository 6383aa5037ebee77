"""JSON bodies of requests: strict parsing, with errors that name the place."""

from __future__ import annotations

import json
from typing import Any

from starlette.requests import Request

from services.api.problems import BadRequest


class JsonRequest(Request):
    """Request whose JSON body must be UTF-8 and give each key of an object once."""

    async def json(self) -> Any:
        """Return the parsed body.

        Raises:
            BadRequest: if the body is not JSON, or gives a key twice.
        """
        if not hasattr(self, "_json"):
            self._json = parsed(await self.body())
        return self._json


def parsed(body: bytes) -> Any:
    """Parse a JSON body.

    Raises:
        BadRequest: if it is not UTF-8 or not JSON, is nested too deeply, has a number that is too long, or gives a key of an
            object twice.
    """
    try:
        return json.loads(body.decode(), object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        raise BadRequest(f"the body is not UTF-8 text at byte {error.start}; send JSON in UTF-8") from error
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise BadRequest(f"the body is not JSON at {place}: {error.msg}") from error
    except RecursionError as error:
        raise BadRequest("the body has too many lists and objects inside each other; send JSON as in /docs") from error
    except ValueError as error:  # Python's limit on the digits of a whole number
        raise BadRequest("the body has a whole number with thousands of digits; send JSON as in /docs") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise BadRequest(f"the body gives the key {key!r:.60} twice in one object; give it once")
        found[key] = value
    return found
