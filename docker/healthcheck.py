"""Whether the server of this container answers: exit code 0 when /livez says 200, else 1 and a line that says what came instead.

The address is HEALTHCHECK_URL, by default that of the probe listener, which answers while the server's own port is full. A certificate is not
checked: it names the server as others call it, and this asks at 127.0.0.1.
"""

from __future__ import annotations

import http.client
import os
import ssl
import sys
import urllib.error
import urllib.request

TIMEOUT_S = 4.0


def main() -> int:
    url = os.environ.get("HEALTHCHECK_URL", "http://127.0.0.1:8001/livez")
    unchecked = ssl.create_default_context()
    unchecked.check_hostname = False
    unchecked.verify_mode = ssl.CERT_NONE
    direct = urllib.request.build_opener(
        urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=unchecked)
    )
    try:
        with direct.open(url, timeout=TIMEOUT_S) as answer:
            if answer.status == 200:
                return 0
            said = f"status {answer.status}"
    except (urllib.error.URLError, http.client.HTTPException, OSError, ValueError) as error:
        said = str(error)
    sys.stdout.write(f"{url}: {said}\n")  # shown by `docker inspect`
    return 1


if __name__ == "__main__":
    sys.exit(main())
