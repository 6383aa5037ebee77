"""Transfer of per-frame scalars from the host to device memory read by captured launches."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsplat_core.errors import InvalidInput
from gsplat_core.ops import native  # noqa: F401  registers the compiled op
from gsplat_core.ops.arguments import require_float32

MOST_SCALARS = 64


def store_scalars_(to: Tensor, values: Sequence[float]) -> None:
    """Write host values into a device tensor without synchronisation.

    On CUDA the values are passed as launch arguments on the current stream, so no host buffer is needed.

    Args:
        to: float32, contiguous.
        values: at most 64 values, as many as `to` has elements.

    Raises:
        InvalidInput: if dtype, layout or count differ from the above.
    """
    require_float32("store_scalars_", to=to)
    if not to.is_contiguous() or to.numel() != len(values) or len(values) > MOST_SCALARS:
        raise InvalidInput(
            f"store_scalars_ fills a contiguous tensor of at most {MOST_SCALARS} elements, got {len(values)} values"
            f" for {list(to.shape)} with strides {list(to.stride())}"
        )
    torch.ops.gsplat_core.store_scalars_(to, list(values))


@torch.library.register_fake("gsplat_core::store_scalars_")
def _(to: Tensor, values: list[float]) -> None:
    return None
