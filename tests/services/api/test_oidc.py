"""OpenID Connect tokens: a local issuer with real keys, and forged tokens."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from pydantic import ValidationError

from services.api.problems import PROBLEM_JSON
from services.audit import Wanted, search
from services.errors import SettingsInvalid
from services.settings import OidcSettings

jwt = pytest.importorskip("jwt", reason="PyJWT is in the extra oidc")
from cryptography.hazmat.primitives import serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec, rsa  # noqa: E402

ROLES = {"theatre": "viewer", "research": "operator", "it": "admin"}


class Issuer:
    """OpenID Connect issuer on this machine that records requested paths."""

    def __init__(self) -> None:
        self.first = rsa.generate_private_key(public_exponent=65537, key_size=2048)
        self.keys: dict[str, Any] = {}
        self.asked: list[str] = []
        self.answer: Any = None
        issuer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                issuer.asked.append(self.path)
                body = json.dumps(issuer.answer or issuer.documents()[self.path]).encode()
                self.send_response(200)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/realms/hospital"
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    def documents(self) -> dict[str, Any]:
        keys = [
            {**_jwk(key), "kid": name, "use": "sig", "alg": "RS256" if isinstance(key, rsa.RSAPrivateKey) else "ES256"}
            for name, key in self.keys.items()
        ]
        base = "/realms/hospital"
        return {
            f"{base}/.well-known/openid-configuration": {"issuer": self.url, "jwks_uri": f"{self.url}/certs"},
            f"{base}/certs": {
                "keys": [
                    *keys,
                    {"kty": "oct", "k": "c2VjcmV0", "kid": "shared"},
                    {**keys[0], "kid": "enc", "use": "enc"},
                ]
            },
        }

    def claims(self, **other: Any) -> dict[str, Any]:
        now_s = int(time.time())
        own = {
            "iss": self.url,
            "aud": "intrasplat",
            "sub": "u-17",
            "exp": now_s + 300,
            "iat": now_s,
            "roles": ["theatre"],
        }
        return {name: value for name, value in {**own, **other}.items() if value is not None}

    def token(self, kid: str | None = "one", algorithm: str = "RS256", key: Any = None, **claims: Any) -> str:
        headers = {} if kid is None else {"kid": kid}
        return jwt.encode(self.claims(**claims), key or self.keys[kid or "one"], algorithm, headers)


def _jwk(key: Any) -> dict[str, Any]:
    kind = jwt.algorithms.RSAAlgorithm if isinstance(key, rsa.RSAPrivateKey) else jwt.algorithms.ECAlgorithm
    return kind.to_jwk(key.public_key(), as_dict=True)


@pytest.fixture(scope="module")
def shared_issuer() -> Iterator[Issuer]:
    made = Issuer()
    yield made
    made.server.shutdown()
    made.server.server_close()


@pytest.fixture
def issuer(shared_issuer: Issuer) -> Issuer:
    shared_issuer.asked.clear()
    shared_issuer.answer = None
    shared_issuer.keys = {"one": shared_issuer.first}
    return shared_issuer


@pytest.fixture
def plane(new_plane, issuer):
    return new_plane(auth={"oidc": {"issuer": issuer.url, "audience": "intrasplat", "roles": ROLES}})


def ask(plane: Any, token: str, path: str = "/v1/version", method: str = "GET", **options: Any) -> Any:
    return plane.client.request(method, path, headers={"Authorization": f"Bearer {token}"}, **options)


def test_token_grants_highest_role_of_its_claim(plane, issuer):
    assert ask(plane, issuer.token()).status_code == 200
    assert ask(plane, issuer.token(), "/v1/audit").status_code == 403
    assert ask(plane, issuer.token(roles=["x", "theatre", "it"]), "/v1/audit").status_code == 200, "the highest counts"
    assert ask(plane, issuer.token(roles="it"), "/v1/keys").status_code == 200
    assert plane.ask("GET", "/v1/version").status_code == 200, "API keys go on"
    assert len(issuer.asked) == 2, "the keys are kept"


def test_audit_log_names_oidc_subject(plane, issuer):
    ask(plane, issuer.token(roles="it"), "/v1/keys", "POST", json={"name": "room", "role": "viewer"})
    ask(plane, issuer.token(roles="it", sub='a "name"\n'), "/v1/keys", "POST", json={"name": "room", "role": "viewer"})
    two, one = search(plane.control.audit.path, Wanted(), 2).entries
    assert one.actor.startswith("u-17 (oidc-") and one.role == "admin"
    assert two.actor.startswith("subject-") and two.actor != one.actor


def test_token_holder_gets_single_use_ticket(plane, issuer):
    path = "/v1/streams/theatre/mjpeg"
    given = ask(plane, issuer.token(), "/v1/tickets", "POST", json={"path": path})
    assert plane.client.get(f"{path}?ticket={given.json()['ticket']}").status_code == 404, (
        "let in; there is no such stream"
    )
    assert plane.client.get(f"{path}?ticket={given.json()['ticket']}").status_code == 401, "once"


@pytest.mark.parametrize(
    "claims",
    [
        {"aud": "another"}, {"aud": None}, {"iss": "http://127.0.0.1/other"}, {"iss": None}, {"exp": 1}, {"exp": None},
        {"exp": "soon"}, {"nbf": 2**33}, {"sub": None}, {"sub": 7}, {"iat": 2**33}, {"aud": ["another"]},
    ],
    ids=str,
)  # fmt: skip
def test_token_with_wrong_claims_or_times_returns_401(plane, issuer, claims):
    answer = ask(plane, issuer.token(**claims))
    assert (answer.status_code, answer.headers["content-type"]) == (401, PROBLEM_JSON)
    assert "WWW-Authenticate" in answer.headers


def test_token_expiry_allows_clock_skew(plane, issuer):
    assert ask(plane, issuer.token(exp=int(time.time()) - 10)).status_code == 200
    assert ask(plane, issuer.token(exp=int(time.time()) - 60)).status_code == 401


def forged(head: dict[str, Any], claims: dict[str, Any], secret: bytes | None) -> str:
    parts = [base64.urlsafe_b64encode(json.dumps(each).encode()).rstrip(b"=") for each in (head, claims)]
    signature = b"" if secret is None else hmac.digest(secret, b".".join(parts), hashlib.sha256)
    return b".".join([*parts, base64.urlsafe_b64encode(signature).rstrip(b"=")]).decode()


def test_tokens_with_forged_signature_return_401(plane, issuer):
    public = issuer.keys["one"].public_key()
    pem = public.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
    other = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    right = issuer.token()
    head, body, signature = right.split(".")
    tokens = [
        forged({"alg": "none", "kid": "one"}, issuer.claims(), None),
        forged({"alg": "None", "kid": "one"}, issuer.claims(), None),
        forged({"alg": "HS256", "kid": "one"}, issuer.claims(), pem),  # the public key taken for a shared secret
        forged({"alg": "HS256", "kid": "shared"}, issuer.claims(), b"secret"),
        forged({"alg": "RS256", "kid": "one", "crit": ["x"], "x": 1}, issuer.claims(), pem),
        issuer.token(key=other),
        issuer.token(kid="enc", key=issuer.keys["one"]),
        issuer.token(kid="one", algorithm="RS512"),
        issuer.token(kid="one", algorithm="ES256", key=ec.generate_private_key(ec.SECP256R1())),
        f"{head}.{body}.", f"{head}.{body}.{signature[:-4]}AAAA", f"{head}.{body[:-2]}.{signature}", "..", "a.b.c",
        "e30.e30.e30", right + 9000 * "a",
    ]  # fmt: skip
    for token in tokens:
        answer = ask(plane, token)
        assert answer.status_code == 401, (token[:60], answer.text)
        assert token not in answer.text
    assert ask(plane, right).status_code == 200


@pytest.mark.parametrize("roles", [None, [], ["guest"], "guest", 7, {"it": True}, [["it"]], [None]])
def test_token_without_known_role_returns_403(plane, issuer, roles):
    answer = ask(plane, issuer.token(roles=roles))
    assert answer.status_code == 403 and "auth.oidc.roles" in answer.json()["detail"]


def test_role_claim_may_be_nested_and_name_claim_is_actor(new_plane, issuer):
    oidc = {"issuer": issuer.url, "audience": "intrasplat", "roles": ROLES, "role_claim": "realm_access.roles"}
    plane = new_plane(auth={"oidc": {**oidc, "name_claim": "preferred_username"}})
    token = issuer.token(roles=None, realm_access={"roles": ["it"]}, preferred_username="jane.doe")
    assert ask(plane, token, "/v1/audit").status_code == 200
    assert search(plane.control.audit.path, Wanted(), 1).entries[0].actor.startswith("jane.doe (oidc-")


def test_issuer_key_rotation_adds_new_and_drops_old_key(plane, issuer, monkeypatch):
    old = issuer.token()
    assert ask(plane, old).status_code == 200
    issuer.keys = {"two": ec.generate_private_key(ec.SECP256R1())}
    assert ask(plane, issuer.token("two", "ES256")).status_code == 401, "asked for a moment ago"
    monkeypatch.setattr("services.auth.oidc.AGAIN_S", 0)
    assert ask(plane, issuer.token("two", "ES256")).status_code == 200
    assert ask(plane, old).status_code == 401
    assert ask(plane, issuer.token(None, "ES256", issuer.keys["two"])).status_code == 200, "the only one needs no id"


def test_issuer_keys_without_alg_accept_algorithms_of_settings(new_plane, issuer):
    key = {
        name: value for name, value in issuer.documents()["/realms/hospital/certs"]["keys"][0].items() if name != "alg"
    }
    issuer.answer = {"keys": [key]}
    oidc = {"issuer": issuer.url, "audience": "intrasplat", "roles": ROLES, "keys_url": issuer.url}
    plane = new_plane(auth={"oidc": {**oidc, "algorithms": ["PS512", "ES256"]}})
    assert ask(plane, issuer.token(algorithm="PS512")).status_code == 200
    assert ask(plane, issuer.token(algorithm="RS256")).status_code == 401
    assert ask(plane, issuer.token(algorithm="ES256", key=ec.generate_private_key(ec.SECP256R1()))).status_code == 401


def test_unknown_key_ids_do_not_refetch_issuer_keys(plane, issuer):
    other = rsa.generate_private_key(public_exponent=65537, key_size=2048)
    for number in range(20):
        assert ask(plane, issuer.token(f"k{number}", key=other)).status_code == 401
    assert len(issuer.asked) == 2


@pytest.mark.parametrize(
    "answer", [{"keys": []}, {"keys": "x"}, [1], "x", {"issuer": "http://other"}, {"keys": [{"kty": "RSA"}]}]
)
@pytest.mark.parametrize("direct", [False, True])
def test_invalid_issuer_response_returns_503_and_api_keys_still_work(new_plane, issuer, answer, direct, caplog):
    issuer.answer = answer
    oidc = {"issuer": issuer.url, "audience": "intrasplat", "roles": ROLES}
    plane = new_plane(auth={"oidc": {**oidc, "keys_url": f"{issuer.url}/certs" if direct else None}})
    assert ask(plane, issuer.token()).status_code == 503
    assert "cannot be had" in caplog.text
    assert plane.ask("GET", "/v1/version").status_code == 200


def test_cached_issuer_keys_are_used_while_issuer_is_unavailable(plane, issuer, monkeypatch):
    keys = plane.control.persons._keys
    assert ask(plane, issuer.token()).status_code == 200
    issuer.answer = "nonsense"
    keys._had_s -= 3600
    keys._tried_s -= 3600
    assert ask(plane, issuer.token()).status_code == 200
    keys._had_s -= 48 * 3600
    assert ask(plane, issuer.token()).status_code == 503


def test_tokens_return_401_without_oidc_setting(new_plane, issuer):
    plane = new_plane()
    assert ask(plane, issuer.token()).status_code == 401
    assert issuer.asked == []


@pytest.mark.parametrize(
    "wrong",
    [{"issuer": "http://login.example"}, {"issuer": "file:///x"}, {"algorithms": ["HS256"]}, {"algorithms": ["none"]}, {"algorithms": []},
     {"roles": {}}, {"roles": {"x": "public"}}, {"audience": ""}, {"keys_url": "http://login.example/keys"}, {"rolls": {}}],
)  # fmt: skip
def test_oidc_settings_reject_insecure_values(wrong):
    with pytest.raises(ValidationError):
        OidcSettings(**{"issuer": "https://login.example", "audience": "x", "roles": ROLES, **wrong})


def test_oidc_setting_without_extra_raises_settings_invalid(new_plane, issuer, monkeypatch):
    monkeypatch.setitem(sys.modules, "jwt", None)
    for name in ("oidc", "issuer_keys"):
        monkeypatch.delitem(sys.modules, f"services.auth.{name}", raising=False)
    with pytest.raises(SettingsInvalid, match="extra oidc"):
        new_plane(auth={"oidc": {"issuer": issuer.url, "audience": "x", "roles": ROLES}})
