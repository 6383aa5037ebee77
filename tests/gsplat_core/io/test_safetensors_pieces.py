"""The pieces of a safetensors file are, put together, what the library writes."""

from __future__ import annotations

import pytest
import safetensors.torch
import torch

from gsplat_core.io import bundle
from gsplat_core.io.bundle import PIECE_BYTES


@pytest.mark.parametrize(
    "shapes",
    [
        {},
        {"a": (0,)},
        {"a": ()},
        {"gaussians.means": (7, 3), "field.weights": (7, 2, 5), "field.empty": (0, 4), "field.window": (1,)},
        {"b": (1,), "a.b": (2, 1), "a": (3,), "Z": (1, 1, 1)},
        {"large": (3, PIECE_BYTES // 8), "small": (5,)},
    ],
)
def test_safetensors_pieces_equal_library_bytes(shapes, generator):
    tensors = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    pieces = [bytes(piece) for piece in bundle.safetensors_pieces(tensors)]
    assert b"".join(pieces) == safetensors.torch.save(tensors)
    assert all(len(piece) <= PIECE_BYTES for piece in pieces[1:])


def test_safetensors_pieces_do_not_copy_tensors():
    values = torch.zeros(PIECE_BYTES // 2)
    _, first, second = bundle.safetensors_pieces({"a": values})
    values.fill_(1.0)
    assert bytes(first[:4]) == bytes(second[:4]) == b"\x00\x00\x80\x3f"


def test_safetensors_piece_ends_with_tensor():
    tensors = {"a": torch.zeros(3), "b": torch.zeros(2)}
    assert [len(piece) for piece in bundle.safetensors_pieces(tensors)][1:] == [12, 8]
