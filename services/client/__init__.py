"""A client of the service's API, for programs and for `intrasplat ctl`."""

from services.client.client import Client
from services.client.errors import ClientError, Refused, Unreachable

__all__ = ["Client", "ClientError", "Refused", "Unreachable"]
