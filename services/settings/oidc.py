"""Settings of OpenID Connect."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from services.settings.section import Section


def _url(text: str) -> str:
    parts = urlsplit(text)
    if parts.scheme == "https" and parts.hostname:
        return text
    if parts.scheme == "http" and parts.hostname and _is_loopback(parts.hostname):
        return text
    raise ValueError(f"{text!r:.100} is no https:// address; http:// is for this machine alone")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Url = Annotated[str, AfterValidator(_url), Field(examples=["https://login.example/realms/hospital"])]


class OidcSettings(Section):
    """OpenID Connect issuer whose users are admitted in addition to API keys; needs the extra oidc."""

    issuer: Url = Field(description="As the issuer calls itself, to the letter.")
    audience: str = Field(
        min_length=1, description="What tokens for this service have as `aud`.", examples=["intrasplat"]
    )
    roles: dict[str, Literal["viewer", "operator", "admin"]] = Field(
        min_length=1,
        description="Role of each value of the claim; the highest counts, without one a token is refused.",
        examples=[{"theatre-staff": "viewer", "research": "operator"}],
    )
    role_claim: str = Field(
        default="roles", min_length=1, description="Claim with a text or a list, such as groups or realm_access.roles."
    )
    name_claim: str = Field(default="sub", min_length=1, description="Claim by which the audit log names a person.")
    keys_url: Url | None = Field(default=None, description="JWK set. Default: what the issuer's discovery names.")
    algorithms: tuple[
        Literal["RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA"], ...
    ] = Field(default=("RS256", "ES256"), min_length=1, description="Algorithms that may have signed a token.")
    ca_file: Path | None = Field(default=None, description="Certificate of the issuer's authority (PEM).")
    leeway_s: float = Field(default=30.0, ge=0, le=300, description="By how much clocks may differ.")
