"""OpenID Connect: tokens of the hospital's issuer accepted in place of API keys. Nothing is stored;
the settings map claims to roles."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from typing import Any

import jwt

from services.control.auth.issuer_keys import IssuerKeys
from services.control.auth.roles import Caller, Role
from services.control.problems import Forbidden, Unauthenticated
from services.settings.sections import OidcSettings

MOST_TOKEN_LENGTH = 8192
_PLAIN_NAME = re.compile(r"[A-Za-z0-9._@+-]{1,80}")


class OpenIdPersons:
    """Verifier of one issuer's tokens: signature, algorithm, issuer, audience and times, then user
    and role."""

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
    """Return a claim by its name or dotted path."""
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
