from __future__ import annotations

import math
import pickle

import pytest

from services.bus.messages import MOST_BYTES, MOST_NESTING, packed_json, parsed_json
from services.errors import BadMessage


def test_json_message_round_trip():
    content = {"state": "live", "counts": {"frames": 3}, "nothing": None}
    assert parsed_json(packed_json(content)) == content


@pytest.mark.parametrize("content", [{"x": math.nan}, {"x": math.inf}, {"x": object()}, {"x": "y" * MOST_BYTES}])
def test_packed_json_raises_for_unsendable_content(content):
    with pytest.raises(BadMessage):
        packed_json(content)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[1]",
        b"3",
        b'{"x": NaN}',
        b'{"x": Infinity}',
        b"{" * 1000,
        b"[" * MOST_BYTES,
        b'{"x":' * 9000 + b"1" + b"}" * 9000,
        b"\xff\xfe",
        pickle.dumps({"x": 1}),
        b'{"x": "' + b"y" * MOST_BYTES + b'"}',
    ],
    ids=lambda data: repr(data[:12]),
)
def test_parsed_json_raises_for_malformed_data(data):
    with pytest.raises(BadMessage):
        parsed_json(data)


@pytest.mark.parametrize("pair", [(b'{"x":', b"}"), (b"[", b"]")], ids=["objects", "lists"])
def test_parsed_json_limits_nesting_depth(pair):
    def nested(depth):
        return b'{"y":0,"x":' + pair[0] * (depth - 1) + b"1" + pair[1] * (depth - 1) + b"}"

    assert parsed_json(nested(MOST_NESTING))["y"] == 0
    with pytest.raises(BadMessage, match="inside each other"):
        parsed_json(nested(MOST_NESTING + 1))
