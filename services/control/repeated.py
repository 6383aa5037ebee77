"""Requests that a caller may send again without their being done again: the header Idempotency-Key."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import Header

from services.control.problems import Unprocessable

IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=200,
        description="A text of the caller's own. A request that is sent again with it is answered as the first time, while the server runs.",
        examples=["9f1c2a6e-take-7"],
    ),
]
MOST_KEPT = 1000


class Repeated:
    """The newest answers by their keys. For one event loop."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, str], tuple[str, asyncio.Task[Any]]] = OrderedDict()

    async def once(self, caller: str, key: str | None, asked: str, act: Callable[[], Awaitable[Any]]) -> Any:
        """What `act` returns, or returned when this caller asked for it with this key. What has failed is done again.

        Raises Unprocessable where the key was used for something else.
        """
        if key is None:
            return await act()
        known = self._kept.get((caller, key))
        if known is not None and known[0] != asked:
            raise Unprocessable("this Idempotency-Key was used for another request; take a new one")
        if known is None or (known[1].done() and (known[1].cancelled() or known[1].exception() is not None)):
            known = asked, asyncio.ensure_future(_awaited(act))
            self._kept[caller, key] = known
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        return await asyncio.shield(known[1])


async def _awaited(act: Callable[[], Awaitable[Any]]) -> Any:
    return await act()
