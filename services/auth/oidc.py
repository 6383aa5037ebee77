"""OpenID Connect: tokens of the hospital's issuer are accepted in place of API keys. Nothing is stored.

The signing keys of the issuer are fetched on demand, cached, and fetched again for an unknown key id.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

import httpx2
import jwt

from services.api.problems import Forbidden, Unauthenticated, Unavailable
from services.auth.keys import Caller, Role
from services.settings import OidcSettings

log = logging.getLogger(__name__)
FRESH_S = 600.0
KEPT_S = 24 * 3600.0
"""Seconds for which cached signing keys stay usable while the issuer does not answer."""
AGAIN_S = 10.0
"""Minimum seconds between requests to the issuer, so unknown key ids and failures do not cause a request each."""
FETCH_S = 5.0
MOST_BYTES = 1 << 20


class IssuerKeys:
    """Public signing keys of one OpenID Connect issuer, fetched and cached by key id."""

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


MOST_TOKEN_LENGTH = 8192
_PLAIN_NAME = re.compile(r"[A-Za-z0-9._@+-]{1,80}")


class OpenIdPersons:
    """Verifier of one issuer's tokens: signature, algorithm, issuer, audience and times, then user and role."""

    def __init__(self, settings: OidcSettings, keys: IssuerKeys | None = None) -> None:
        self._settings = settings
        self._keys = keys or IssuerKeys(settings)

    async def caller_of(self, token: str) -> Caller:
        """Return the caller of a token.

        Raises:
            Unauthenticated: if the token is not valid.
            Forbidden: if the token's claims give no role.
            Unavailable: if the issuer's keys cannot be fetched.
        """
        if len(token) > MOST_TOKEN_LENGTH:
            raise Unauthenticated(f"the token has {len(token)} characters; at most {MOST_TOKEN_LENGTH} are taken")
        settings = self._settings
        try:
            head = jwt.get_unverified_header(token)
            if head.get("alg") not in settings.algorithms:
                raise Unauthenticated(
                    f"the token is signed by {str(head.get('alg'))!r:.20}; taken are {', '.join(settings.algorithms)}"
                )
            key = await self._keys.key(head.get("kid"), str(head["alg"]))
            claims = jwt.decode(
                token, key, algorithms=[head["alg"]], audience=settings.audience, issuer=settings.issuer,
                leeway=settings.leeway_s, options={"require": ["exp", "iss", "aud", "sub"]},
            )  # fmt: skip
        except jwt.PyJWTError as error:
            raise Unauthenticated(f"the token is not taken: {error}; sign in again") from error
        return self._caller(claims)

    def _caller(self, claims: Mapping[str, Any]) -> Caller:
        settings = self._settings
        given = _claim(claims, settings.role_claim)
        values = [given] if isinstance(given, str) else given if isinstance(given, list) else []
        roles = [Role(settings.roles[value]) for value in values if isinstance(value, str) and value in settings.roles]
        name, number = _name(claims, settings)
        if not roles:
            raise Forbidden(
                f"the token's claim {settings.role_claim} gives {name} no role here; auth.oidc.roles maps its values"
            )
        expires_at = float(claims["exp"]) + settings.leeway_s
        return Caller(name, number, max(roles, key=list(Role).index), federated=True, expires_at=expires_at)


def _claim(claims: Mapping[str, Any], path: str) -> Any:
    """Return a claim by its name or dotted path; None if it is missing."""
    if path in claims:
        return claims[path]
    found: Any = claims
    for part in path.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _name(claims: Mapping[str, Any], settings: OidcSettings) -> tuple[str, str]:
    """Return the user's name for the audit log, and an id derived from issuer and subject."""
    digest = hashlib.sha256(f"{settings.issuer}\n{claims['sub']}".encode()).hexdigest()[:16]
    name = str(_claim(claims, settings.name_claim) or claims["sub"])
    return name if _PLAIN_NAME.fullmatch(name) else f"subject-{digest[:8]}", f"oidc-{digest}"
