"""Charts: valid SVG, round ticks, gaps at missing values."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest

from services.reports.figures import NARROW, WIDE, Chart, Line, _axis, _log_axis, _number


def chart(*lines, **options):
    return Chart("title", "what it shows", "x", "y", lines, **options)


def test_chart_draws_rising_line_left_to_right_and_upwards():
    svg = ElementTree.fromstring(chart(Line("a", [0, 1, 2], [10.0, 20.0, 30.0], "main")).svg())
    (line,) = svg.iter("polyline")
    points = [tuple(map(float, pair.split(","))) for pair in line.get("points").split()]
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert [y for _, y in points] == sorted((y for _, y in points), reverse=True), "SVG's y axis points down"
    assert svg.get("role") == "img" and "what it shows" in svg.get("aria-label")


def test_chart_breaks_line_at_missing_value_and_marks_single_point():
    svg = ElementTree.fromstring(chart(Line("a", [0, 1, 2, 3, 4], [1.0, 2.0, None, 3.0, None], "main")).svg())
    assert len(list(svg.iter("polyline"))) == 1
    assert len([c for c in svg.iter("circle") if c.get("class") == "mark main"]) == 1


@pytest.mark.parametrize("values", [[], [5.0], [None], [3.0, 3.0]])
def test_chart_of_empty_single_or_constant_data_is_valid_svg(values):
    ElementTree.fromstring(chart(Line("a", list(range(len(values))), values, "main")).svg())


def test_chart_escapes_text():
    page = chart(Line("<b>", [0, 1], [0.0, 1.0], "main")).figure()
    assert "<b>" not in page and "&lt;b&gt;" in page


def test_axis_ticks_are_round_and_span_data():
    axis = _axis(33.2, 38.9, 5, tight=False)
    assert axis.ticks[0] == axis.low and axis.ticks[-1] == pytest.approx(axis.high)
    assert axis.low <= 33.2 and axis.high >= 38.9
    assert {round(b - a, 9) for a, b in zip(axis.ticks, axis.ticks[1:], strict=False)} == {2.0}
    assert (axis.position(axis.low), axis.position(axis.high)) == (0.0, 1.0)


def test_log_axis_spaces_decades_evenly():
    axis = _log_axis(1.0, 100.0)
    assert {1.0, 10.0, 100.0} <= set(axis.ticks)
    assert axis.position(10) - axis.position(1) == pytest.approx(axis.position(100) - axis.position(10))


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1234.5, "1,234"), (0.25, "0.25"), (37.2468, "37.25"), (-3.0, "-3"), (1000000, "1,000,000")],
)
def test_number_has_at_most_four_significant_digits(value, text):
    assert _number(value) == text


@pytest.mark.parametrize("x_log", [False, True])
@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_chart_points_match_axis_ticks(x_log, width):
    """Compares pixel positions of the curve with those of the labelled ticks."""
    x, y = [0.5, 2.0, 7.0, 30.0, 80.0], [31.0, 34.5, None, 36.25, 33.0]
    chart = Chart(
        "T", "D", "time", "PSNR", (Line("a", x, y, "main"),), x_unit=" s", y_unit=" dB", x_log=x_log, width=width
    )
    svg = ElementTree.fromstring(chart.svg())
    assert svg.attrib["viewBox"] == f"0 0 {width} 290"
    grid = svg.find("g")
    lines = [each for each in grid.findall("line") if "class" not in each.attrib]
    ticks = [each for each in grid.findall("line") if each.attrib.get("class") == "tick"]
    texts = [each for each in grid.findall("text") if "class" not in each.attrib]
    levels, places = texts[: len(lines)], texts[len(lines) :]
    assert len(lines) >= 4 and len(places) == len(ticks) >= 3
    for line, text in zip(lines, levels, strict=True):
        assert line.attrib["y1"] == line.attrib["y2"] and (line.attrib["x1"], line.attrib["x2"]) == (
            "56",
            str(width - 16),
        )
        assert float(text.attrib["y"]) == pytest.approx(float(line.attrib["y1"]) + 4) and text.attrib["x"] == "48"
    for tick, text in zip(ticks, places, strict=True):
        assert tick.attrib["x1"] == tick.attrib["x2"] == text.attrib["x"]
        assert (tick.attrib["y1"], tick.attrib["y2"], text.attrib["y"]) == ("246", "251", "265")
    scale = math.log10 if x_log else float
    rows = np.polyfit([float(each.text) for each in levels], [float(each.attrib["y1"]) for each in lines], 1)
    columns = np.polyfit([scale(float(each.text)) for each in places], [float(each.attrib["x1"]) for each in ticks], 1)
    assert rows[0] < 0 < columns[0], "values grow to the right and upwards"
    points = [each for each in svg.findall("circle") if each.attrib["class"] == "hover"]
    known = [(a, b) for a, b in zip(x, y, strict=True) if b is not None]
    for point, (a, b) in zip(points, known, strict=True):
        assert float(point.attrib["cx"]) == pytest.approx(np.polyval(columns, scale(a)), abs=0.15)
        assert float(point.attrib["cy"]) == pytest.approx(np.polyval(rows, b), abs=0.15)
        assert 56 <= float(point.attrib["cx"]) <= width - 16 and 14 <= float(point.attrib["cy"]) <= 246
        assert point.find("title").text == f"a: {b:g} dB at {a:g} s"
    drawn = [line.attrib["points"].split() for line in svg.findall("polyline")]
    at = [f"{point.attrib['cx']},{point.attrib['cy']}" for point in points]
    assert drawn == [at[:2], at[2:]]
    names = [each for each in grid.findall("text") if each.attrib.get("class") == "axis"]
    assert [each.text for each in names] == ["time", "PSNR"]
    assert float(names[0].attrib["x"]) == (56 + width - 16) / 2 and names[0].attrib["y"] == "284"
    assert names[1].attrib["transform"] == "rotate(-90 13 130.0)"


@pytest.mark.parametrize(
    ("values", "ticks"),
    [
        ((0.0, 1.0), ["0", "0.2", "0.4", "0.6", "0.8", "1"]),
        ((31.0, 36.2), ["30", "32", "34", "36", "38"]),
        ((0.0, 470.0), ["0", "100", "200", "300", "400", "500"]),
        ((5.0, 5.0), ["4.4", "4.6", "4.8", "5", "5.2", "5.4", "5.6"]),
        ((-0.03, 0.04), ["-0.04", "-0.02", "0", "0.02", "0.04"]),
    ],
)
def test_chart_y_axis_ends_at_round_ticks(values, ticks):
    svg = ElementTree.fromstring(Chart("T", "D", "x", "y", (Line("a", [0.0, 1.0], values, "main"),)).svg())
    shown = [each.text for each in svg.find("g").findall("text") if each.attrib.get("text-anchor") == "end"]
    assert shown == ticks


def test_chart_marks_are_points_with_round_key():
    chart = Chart("T", "D", "x", "y", (Line("a", [0.0, 1.0], [2.0, 3.0], "second", marks=True),))
    svg = ElementTree.fromstring(chart.svg())
    assert svg.find("polyline") is None
    assert [(each.attrib["class"], each.attrib["r"]) for each in svg.findall("circle")] == [("mark second", "3.5")] * 2
    assert '<span class="key second round"></span>a' in chart.figure()
