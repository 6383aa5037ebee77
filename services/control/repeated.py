"""Idempotent requests: answers cached by the Idempotency-Key header."""

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
    """Cache of recent answers by caller and idempotency key. For use in one event loop."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, str], tuple[str, asyncio.Task[Any]]] = OrderedDict()

    async def once(self, caller: str, key: str | None, asked: str, act: Callable[[], Awaitable[Any]]) -> Any:
        """Run `act` once per caller and key; later calls return the first result. Failed runs are
        not cached.

        Args:
            caller: key id of the caller.
            key: the Idempotency-Key; without it `act` always runs.
            asked: fingerprint of the request.
            act: performs the request.

        Raises:
            Unprocessable: if the key was used for a different request.
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
