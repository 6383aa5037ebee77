"""Signing keys of an OpenID Connect issuer: fetched on demand, cached, and refetched for an unknown
key id."""

from __future__ import annotations

import asyncio
import json
import logging
import ssl
import time
from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import urlsplit

import httpx2
import jwt

from services.control.problems import Unauthenticated, Unavailable
from services.settings.sections import OidcSettings

log = logging.getLogger(__name__)
FRESH_S = 600.0
KEPT_S = 24 * 3600.0
"""Seconds for which cached keys stay usable while the issuer does not answer."""
AGAIN_S = 10.0
"""Minimum seconds between requests to the issuer, so unknown key ids and failures do not cause a
request each."""
FETCH_S = 5.0
MOST_BYTES = 1 << 20


class IssuerKeys:
    """Public keys of one issuer by key id."""

    def __init__(
        self,
        settings: OidcSettings,
        fetch: Callable[[str], Awaitable[Any]] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._fetch = fetch or self._fetched
        self._clock = clock
        self._keys: dict[str, dict[str, Any]] = {}
        self._had_s = self._tried_s = float("-inf")
        self._lock = asyncio.Lock()

    async def key(self, key_id: str | None, algorithm: str) -> jwt.PyJWK:
        """Return the key for an algorithm. Without an id the issuer must have only one key.

        Raises:
            Unauthenticated: if the issuer does not have the key.
            jwt.PyJWTError: if the key has another type.
            Unavailable: if no keys can be fetched.
        """
        if not self._is_fresh() or self._found(key_id) is None:
            async with self._lock:  # waiting requests use the keys that the first one fetched
                if (not self._is_fresh() or self._found(key_id) is None) and self._clock() - self._tried_s >= AGAIN_S:
                    await self._renew()
        if self._clock() - self._had_s > KEPT_S:
            raise Unavailable("the issuer's keys cannot be had now; use an API key, or try again soon")
        found = self._found(key_id)
        if found is None or found.get("alg", algorithm) != algorithm:
            raise Unauthenticated("the token is signed by a key that its issuer does not have for this; sign in again")
        return jwt.PyJWK(found, algorithm)

    def _is_fresh(self) -> bool:
        return self._clock() - self._had_s <= FRESH_S

    def _found(self, key_id: str | None) -> dict[str, Any] | None:
        if key_id is None:
            return next(iter(self._keys.values())) if len(self._keys) == 1 else None
        return self._keys.get(key_id)

    async def _renew(self) -> None:
        self._tried_s = self._clock()
        try:
            self._keys = _signing_keys(await self._fetch(await self._keys_url()))
            self._had_s = self._clock()
        except (httpx2.HTTPError, OSError, ValueError, KeyError, TypeError, AttributeError, jwt.PyJWTError) as error:
            log.error("the keys of %s cannot be had: %s", self._settings.issuer, error or type(error).__name__)

    async def _keys_url(self) -> str:
        if self._settings.keys_url is not None:
            return self._settings.keys_url
        about = await self._fetch(f"{self._settings.issuer.rstrip('/')}/.well-known/openid-configuration")
        if about["issuer"] != self._settings.issuer:
            raise ValueError(
                f"it calls itself {about['issuer']!r:.100}; auth.oidc.issuer must be the same, to the letter"
            )
        url = str(about["jwks_uri"])
        if urlsplit(url).scheme != "https" and urlsplit(self._settings.issuer).scheme == "https":
            raise ValueError("its keys are not behind TLS")
        return url

    async def _fetched(self, url: str) -> Any:
        ca = self._settings.ca_file
        context = ssl.create_default_context(cafile=None if ca is None else str(ca))
        async with (
            asyncio.timeout(FETCH_S),
            httpx2.AsyncClient(verify=context, timeout=FETCH_S, trust_env=False) as client,
            client.stream("GET", url) as answer,
        ):
            answer.raise_for_status()
            body = b""
            async for part in answer.aiter_bytes():
                body += part
                if len(body) > MOST_BYTES:
                    raise ValueError(f"{url} has more than {MOST_BYTES} bytes")
        return json.loads(body)


def _signing_keys(document: Any) -> dict[str, dict[str, Any]]:
    """Return the asymmetric signing keys of a JWK set, without encryption keys and shared secrets.

    Raises:
        ValueError: if there is none.
    """
    found = {
        str(each.get("kid", "")): dict(each)
        for each in document["keys"]
        if each.get("kty") in ("RSA", "EC", "OKP") and each.get("use", "sig") == "sig"
    }
    if not found:
        raise ValueError("it has no key that signs")
    for each in found.values():
        jwt.PyJWK(each)  # raises for an invalid key
    return found
