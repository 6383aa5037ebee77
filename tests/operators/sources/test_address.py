"""Options of addresses: each kind of value at both of its borders, and refusals that name option and range."""

from __future__ import annotations

import math
import re

import pytest

from gsplat_core.errors import InvalidSetting
from operators.sources.address import PARSERS, Address, SourceOptions, UrlAddress


def test_address_parse_returns_place_and_options():
    address = Address.parse("pipe", "/path/of a/fifo?size=640x512&name=a%20b&empty=")
    assert (address.scheme, address.place) == ("pipe", "/path/of a/fifo")
    assert address.options == {"size": "640x512", "name": "a b", "empty": ""}
    assert address.text("name") == "a b" and address.text("none") is None and address.text("none", "x") == "x"
    assert Address.parse("pipe", "-").options == {}


@pytest.mark.parametrize("query", ["a=1&a=1", "b=3&a=1&a=2", "a=1&b=2&a=3"])
def test_address_refuses_duplicate_option(query):
    with pytest.raises(InvalidSetting, match="pipe: the option 'a' occurs twice"):
        Address.parse("pipe", f"-?{query}")


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        ("number", None, 3.5),
        ("number", "2", 2.0),
        ("number", "1.9", None),
        ("number", "9", 9.0),
        ("number", "9.1", None),
        ("number", "nan", None),
        ("number", "x", None),
        ("whole", None, 5),
        ("whole", "2", 2),
        ("whole", "1", None),
        ("whole", "9", 9),
        ("whole", "10", None),
        ("whole", "-3", None),
        ("whole", "3.0", None),
        ("whole", "0" * 19 + "3", 3),
        ("whole", "0" * 20 + "3", None),
        ("whole", "\u0663", None),  # a digit, but none of ASCII
        ("flag", None, True),
        ("flag", "", True),
        ("flag", "1", True),
        ("flag", "True", True),
        ("flag", "yes", True),
        ("flag", "0", False),
        ("flag", "false", False),
        ("flag", "NO", False),
        ("flag", "2", None),
        ("size", "640x512", (640, 512)),
        ("size", "1x1", (1, 1)),
        ("size", "8192x8192", (8192, 8192)),
        ("size", "8193x1", None),
        ("size", "1x8193", None),
        ("size", "0x5", None),
        ("size", "5x0", None),
        ("size", "5", None),
        ("choice", None, "red"),
        ("choice", "blue", "blue"),
        ("choice", "green", None),
    ],
)
def test_address_option_values_and_defaults_by_kind(kind, text, value):
    address = Address("cam", "0", {} if text is None else {"it": text})
    read = {
        "number": lambda: address.number("it", 3.5, 2, 9),
        "whole": lambda: address.whole("it", 5, 2, 9),
        "flag": lambda: address.flag("it", True),
        "size": lambda: address.size("it"),
        "choice": lambda: address.choice("it", "red", ("red", "blue")),
    }[kind]
    if value is None:
        with pytest.raises(InvalidSetting, match="cam: it is "):
            read()
    else:
        assert read() == value
    address.refuse_others()  # an option that was asked for is no other one


def test_missing_size_is_none_and_missing_flag_is_false():
    address = Address("cam", "0")
    assert address.size() is None and address.flag("it") is False


def test_refuse_others_error_lists_known_options():
    address = Address("cam", "0", {"fsp": "30"})
    with pytest.raises(InvalidSetting, match="unknown option 'fsp'; known are none"):
        address.refuse_others()
    address.number("fps", 30, 1, 60)
    address.text("format")
    with pytest.raises(InvalidSetting, match="unknown option 'fsp'; known are format, fps"):
        address.refuse_others()


@pytest.mark.parametrize(
    ("name", "possible", "impossible"),
    [
        ("speed", [1e-9, 1000.0, math.inf], [0.0, -1.0, 1000.001, math.nan]),
        ("fps", [None, 1e-9, 1000.0], [0.0, -1.0, 1000.001, math.inf, math.nan]),
        ("waiting", [1, 64], [0, 65]),
        ("stereo", [None, "side_by_side", "top_bottom"], ["both", ""]),
    ],
)
def test_source_options_refuse_values_out_of_range(name, possible, impossible):
    for value in possible:
        assert getattr(SourceOptions(**{name: value}), name) == value
    for value in impossible:
        with pytest.raises(InvalidSetting, match=f"^{name} is "):
            SourceOptions(**{name: value})


def test_source_options_defaults():
    options = SourceOptions()
    assert (options.waiting, options.speed, options.scale, options.fps, options.max_frames) == (2, 1.0, 1.0, None, None)
    assert not (options.realtime or options.loop or options.bounce)


@pytest.mark.parametrize(
    ("scheme", "name", "least", "most", "beyond"),
    [
        ("synthetic", "width", "32", "4096", ("31", "4097")),
        ("synthetic", "height", "32", "4096", ("31", "4097")),
        ("synthetic", "fps", "1", "240", ("0.9", "240.1")),
        ("synthetic", "seed", "0", "9223372036854775807", ("-1", "9223372036854775808")),
        ("synthetic", "eyes", "1", "2", ("0", "3")),
        ("synthetic", "frames", "1", "1000", ("0", "1001")),
        ("v4l2", "size", "1x1", "8192x8192", ("0x1", "1x0", "8193x1", "1x8193")),
        ("v4l2", "fps", "0.01", "1000", ("0.009", "1001")),
        ("folder", "fps", "0.01", "1000", ("0.009", "1001")),
        ("folder", "open_s", "0.1", "600", ("0.09", "601")),
        ("realtime", "speed", "0.01", "1000", ("0.009", "1001")),
        ("realtime", "fps", "0.01", "1000", ("0.009", "1001")),
        ("zmq+tcp", "fps", "0.01", "1000", ("0.009", "1001")),
        ("zmq+ipc", "open_s", "0.1", "600", ("0.09", "601")),
    ],
)
def test_address_options_refuse_values_out_of_range(scheme, name, least, most, beyond):
    for value in (least, most):
        PARSERS[scheme](f"place?{name}={value}", SourceOptions())
    for value in beyond:
        with pytest.raises(InvalidSetting, match=rf"^{re.escape(scheme)}: {name} is '{value}'"):
            PARSERS[scheme](f"place?{name}={value}", SourceOptions())


@pytest.mark.parametrize("name", ["open_s", "stall_s"])
def test_url_timeouts_refuse_values_out_of_range(name):
    for value in ("0.1", "600"):
        assert getattr(UrlAddress.parse("rtsp", f"scope:554/live#{name}={value}"), name) == float(value)
    for value in ("0.09", "601"):
        with pytest.raises(InvalidSetting, match=f"{name} is '{value}'; it must be a number from 0.1 to 600"):
            UrlAddress.parse("rtsp", f"scope:554/live#{name}={value}")


def test_address_option_defaults():
    synthetic = PARSERS["synthetic"]("", SourceOptions())
    assert (synthetic.width_px, synthetic.height_px, synthetic.fps, synthetic.seed, synthetic.eyes) == (
        640,
        512,
        30,
        0,
        1,
    )
    assert synthetic.frames is None and not synthetic.moving
    assert PARSERS["synthetic"]("", SourceOptions(fps=25.0)).fps == 25
    assert (
        PARSERS["folder"]("place", SourceOptions()).open_s == PARSERS["zmq+tcp"]("place", SourceOptions()).open_s == 10
    )
    url = UrlAddress.parse("rtsp", "scope:554/live")
    assert (url.open_s, url.stall_s, url.transport) == (10, 5, "tcp")


def test_url_analyzeduration_is_nine_tenths_of_open_timeout():
    options = UrlAddress.parse("rtsp", "scope:554/live#open_s=20&transport=udp").options()
    assert options["analyzeduration"] == "18000000" and options["rtsp_transport"] == "udp"
    assert "rtsp_transport" not in UrlAddress.parse("http", "scope/live").options()


@pytest.mark.parametrize(("host", "is_one"), [("a" * 63 + ".b", True), ("a" * 64 + ".b", False), (".".join(["a" * 62] * 4) + ".b", True), (".".join(["a" * 62] * 4) + ".bcd", False)])  # fmt: skip
def test_url_host_limits_labels_to_63_and_name_to_253_characters(host, is_one):
    if is_one:
        assert UrlAddress.parse("http", f"{host}/live").name == f"http://{host}/live"
        return
    with pytest.raises(InvalidSetting, match="which is no host"):
        UrlAddress.parse("http", f"{host}/live")
