"""Options of addresses: each kind of value at both of its borders, and refusals that name option and range."""

from __future__ import annotations

import math

import pytest

from gsplat_core.errors import InvalidSetting
from operators.sources.address import Address, SourceOptions


def test_an_address_has_a_place_and_options():
    address = Address.parse("pipe", "/path/of a/fifo?size=640x512&name=a%20b&empty=")
    assert (address.scheme, address.place) == ("pipe", "/path/of a/fifo")
    assert address.options == {"size": "640x512", "name": "a b", "empty": ""}
    assert address.text("name") == "a b" and address.text("none") is None and address.text("none", "x") == "x"
    assert Address.parse("pipe", "-").options == {}


@pytest.mark.parametrize("query", ["a=1&a=1", "b=3&a=1&a=2", "a=1&b=2&a=3"])
def test_an_option_that_is_there_twice_is_refused(query):
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
def test_each_kind_of_option_has_its_values(kind, text, value):
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


def test_no_size_is_none_and_no_flag_is_no():
    address = Address("cam", "0")
    assert address.size() is None and address.flag("it") is False


def test_an_option_that_nobody_asked_for_is_refused_with_the_known_ones():
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
def test_options_have_ranges(name, possible, impossible):
    for value in possible:
        assert getattr(SourceOptions(**{name: value}), name) == value
    for value in impossible:
        with pytest.raises(InvalidSetting, match=f"^{name} is "):
            SourceOptions(**{name: value})


def test_a_source_that_is_asked_for_nothing_keeps_two_frames_and_the_recorded_pace():
    options = SourceOptions()
    assert (options.waiting, options.speed, options.scale, options.fps, options.max_frames) == (2, 1.0, 1.0, None, None)
    assert not (options.realtime or options.loop or options.bounce)
