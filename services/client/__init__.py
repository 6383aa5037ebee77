"""Python client of the service's API, also used by `intrasplat ctl`."""

from services.client.client import Client
from services.errors import ClientError, Refused, Unreachable

__all__ = ["Client", "ClientError", "Refused", "Unreachable"]
