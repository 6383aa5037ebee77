from __future__ import annotations

import pytest

from gsplat_core.errors import InvalidSetting
from services.cli.options import check_host


@pytest.mark.parametrize("host", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_check_host_accepts_loopback(host):
    check_host(host, False, "why")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.5", "theatre.example", ""])
def test_check_host_requires_plaintext_for_other_hosts(host):
    with pytest.raises(InvalidSetting, match="sent in the clear; give --plaintext"):
        check_host(host, False, "sent in the clear")
    check_host(host, True, "sent in the clear")
