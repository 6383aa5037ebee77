"""A source that does what its address says, in whatever process it is."""

import logging
import os
import signal
import time

import numpy as np

from gsplat_core.errors import InvalidSetting
from gsplat_core.scene.cameras import Camera
from gsplat_core.scene.frames import Frame
from operators.sources.live import LiveSource
from operators.sources.source import SourceDescription


class StandIn(LiveSource):
    def __init__(self, steps):
        super().__init__(waiting=64)
        self.steps = steps
        self.description = SourceDescription(
            "stand-in", 24, 16, 25.0, Camera.from_focal(30.0, 24, 16), notes=("assumed",)
        )

    def frames(self):
        seq = 0
        for step in self.steps:
            what, _, value = step.partition("=")
            if what == "frames":
                for _ in range(int(value)):
                    yield Frame(seq, seq * 40_000_000, np.full((16, 24, 3), seq % 256, np.uint8))
                    seq += 1
            elif what == "size":
                side = int(value)
                yield Frame(seq, seq * 40_000_000, np.full((side, side, 3), seq % 256, np.uint8))
                seq += 1
            elif what == "crash":
                time.sleep(0.3)
                os.kill(os.getpid(), getattr(signal, value))
            elif what == "once":  # fails the first time only
                if not os.path.exists(value):
                    open(value, "w").close()
                    time.sleep(0.3)
                    os.kill(os.getpid(), signal.SIGSEGV)
            elif what == "raise":
                time.sleep(0.3)
                raise ValueError(value)
            elif what == "refuse":
                raise InvalidSetting(value)
            elif what == "lost":
                self.lost(value)
            elif what == "log":
                logging.getLogger("stand-in").warning(value)
            elif what == "pause":
                time.sleep(float(value))
            elif what == "block":
                time.sleep(1000)


def opener(address, options):
    if address.startswith("refuse"):
        raise InvalidSetting(address)
    if address.startswith("break"):
        raise RuntimeError("out of order")
    if address.startswith("silent"):
        time.sleep(1000)
    if address.startswith("exit"):
        os._exit(3)
    return StandIn(address.split(","))
