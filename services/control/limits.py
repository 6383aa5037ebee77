"""Token buckets, and the middleware that limits the request rate of each address."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable

from starlette.types import ASGIApp, Receive, Scope, Send

from services.control.answers import response_of
from services.control.measures import Measures
from services.control.problems import TooManyRequests

MOST_BUCKETS = 20_000


class TokenBuckets:
    """Token bucket per caller: `rate_per_s` tokens are added per second, at most `burst` are kept."""

    def __init__(self, rate_per_s: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate_per_s
        self._burst = max(1.0, burst)
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, caller: str, tokens: float = 1.0) -> float:
        """Take tokens from a caller's bucket.

        Returns:
            0 if there were enough tokens; otherwise the seconds until there are, and none is taken.
        """
        now_s = self._clock()
        left, at_s = self._buckets.pop(caller, (self._burst, now_s))
        left = min(self._burst, left + (now_s - at_s) * self._rate)
        enough = left >= tokens
        self._buckets[caller] = (left - tokens if enough else left, now_s)
        if len(self._buckets) > MOST_BUCKETS:
            self._buckets.popitem(last=False)  # least recently used: its bucket is full again, or nearly
        return 0.0 if enough else (tokens - left) / self._rate


class AddressRate:
    """Middleware that answers 429 to an address above its request rate."""

    def __init__(self, app: ASGIApp, buckets: TokenBuckets, measures: Measures) -> None:
        self._app = app
        self._buckets = buckets
        self._measures = measures

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)
        wait_s = self._buckets.wait_s(network_of(scope))
        if wait_s == 0:
            return await self._app(scope, receive, send)
        self._measures.refused.labels("address rate").inc()
        problem = TooManyRequests(f"too many requests from this address; wait {wait_s:.1f} s", wait_s)
        if scope["type"] == "websocket":
            await receive()  # websocket.connect
            return await send({"type": "websocket.close", "code": 1013})  # before accept: the client gets 403
        await response_of(problem, scope)(scope, receive, send)


def network_of(scope: Scope) -> str:
    """Return the network of a request's client, used as rate limit key."""
    return network_of_address((scope.get("client") or ("unknown", 0))[0])


def network_of_address(host: str) -> str:
    """Return the network of an address: the /64 for IPv6, since one host can use a whole /64,
    otherwise the address."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    mapped = getattr(address, "ipv4_mapped", None)
    if mapped is not None:
        return str(mapped)
    return str(ipaddress.ip_network((address, 64), strict=False)) if address.version == 6 else host
