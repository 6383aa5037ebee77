"""Invalid options in a source address are refused when the stream is created."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from gsplat_core.errors import InvalidSetting
from gsplat_core.io.recordings.synthetic.synthesize import MAX_SEED as SYNTHESIZED
from operators.settings import MAX_SEED
from operators.sources.address import PARSERS, PROTOCOLS
from operators.sources.registry import SOURCES, check_address
from services.settings import StreamSettings
from services.supervisor.worker import specs_of


@pytest.mark.parametrize(
    ("address", "option"),
    [
        ("synthetic:?fps=nan", "fps"), ("synthetic:?fps=inf", "fps"), ("synthetic:?fps=-1", "fps"), ("synthetic:?fps=", "fps"),
        ("synthetic:?fps=1e400", "fps"), ("synthetic:?width=0", "width"), ("synthetic:?width=1e3", "width"),
        ("synthetic:?height=99999999999999999999999", "height"), ("synthetic:?frames=0", "frames"), ("synthetic:?moving=maybe", "moving"),
        ("synthetic:?eyes=3", "eyes"), ("synthetic:?sead=1", "sead"), ("synthetic:?fps=30&fps=30", "fps"),
        ("synthetic:?stereo=both", "stereo"), ("v4l2:/dev/video0?size=big", "size"), ("v4l2:/dev/video0?fps=nan", "fps"),
        ("rtsp://10.0.0.1/x#open_s=nan", "open_s"), ("rtsp://10.0.0.1/x#transport=carrier", "transport"),
        ("rtsp://10.0.0.1/x#opens=1", "opens"), ("stereo:synthetic:|synthetic:?fps=nan", "fps"),
        ("realtime:/a?speed=nan", "speed"), ("folder:/a?every=x", "every"), ("zmq+tcp://10.0.0.1:1?open_s=inf", "open_s"),
        ("pipe:/a?format=rgb24", "size"), ("pipe:/a?size=64x48", "format"), ("v4l2:/dev/video0?format=film", "format"),
    ],
)  # fmt: skip
def test_specs_of_raises_for_invalid_source_option(address, option):
    with pytest.raises(InvalidSetting, match=option):
        specs_of("theatre-1", StreamSettings(source=address))


@pytest.mark.parametrize(
    "address",
    [
        "synthetic:", "synthetic:?width=320&height=256&frames=24&moving=1", "synthetic:?fps=30&seed=3&eyes=2",
        "rtsp://user:pass@10.0.0.1:554/x?fps=nan#transport=udp&open_s=3", "v4l2:/dev/video0?size=640x480&fps=30",
        "rtsp://10.0.0.1/x#stereo=side_by_side", "recording:/a/b", "realtime:/a?speed=max&loop=bounce", "folder:/a?every=1&fps=5",
        "pipe:/a?size=64x48&format=rgb24", "udp://0.0.0.0:5000",
    ],
)  # fmt: skip
def test_check_address_accepts_valid_addresses(address):
    check_address(address)


def test_option_parsers_cover_all_source_schemes_with_options():
    assert set(PARSERS) <= set(SOURCES) and set(SOURCES) - set(PARSERS) == {"recording", *PROTOCOLS}
    assert MAX_SEED == SYNTHESIZED


@pytest.mark.parametrize("name", ["field", "renderer", "tool_mask", "depth"])
def test_stream_settings_reject_unknown_engine_option_values(name):
    with pytest.raises(ValidationError, match=f"{name} is 'nope'"):
        StreamSettings(source="synthetic:", options={name: "nope"})
