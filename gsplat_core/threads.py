"""The number of threads that torch uses in one thread of this process.

LAPACK, BLAS and torch's own reductions share long sums among their threads, so their rounding depends on how many there are: a solved system of 200
unknowns or the mean of 40,000 pixels has other last bits with two threads than with one. Geometry runs such operations within `one_thread`.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def use_one_thread() -> None:
    """Let torch operations of the calling thread use one core from now on. Other threads keep their number.

    torch stores the number for the calling thread, and as the default of threads that have not computed yet. Another thread restores that default.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    other = threading.Thread(target=torch.set_num_threads, args=(before,))
    other.start()
    other.join()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch operations of the calling thread use one core inside the block, or inside the decorated function.

    Their results then do not depend on the number of threads. Nested use costs nothing. The outermost use takes about 0.1 ms.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    use_one_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)
