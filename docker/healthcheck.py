"""Health check of a container: exit code 0 if /livez returns status 200, otherwise 1 and one line with the status or error.

The address is HEALTHCHECK_URL. Its default is the probe listener, which answers even if the server's port has reached its connection limit.
The certificate is not verified, because the check connects to 127.0.0.1 and the certificate has the server's public name.
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
