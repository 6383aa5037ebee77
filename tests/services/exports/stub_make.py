"""Stand-in for the export program. The name of the given folder selects its behaviour."""

from __future__ import annotations

import sys
import time
from pathlib import Path

folder, file = Path(sys.argv[1]), Path(sys.argv[2])
if folder.name == "refused":
    sys.stderr.write("warning: something else\nthe model has no Gaussians\n")
    sys.exit(2)
if folder.name == "fails":
    sys.exit("it broke")
if folder.name == "slow":
    time.sleep(60)
file.write_bytes(f"{folder.name} {' '.join(sys.argv[3:])} ".encode() + bytes(1000))
