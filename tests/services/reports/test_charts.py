"""Charts: valid SVG, ticks at round numbers, gaps where there is nothing."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from services.reports.charts import Chart, Line, _axis, _log_axis, _number


def chart(*lines, **options):
    return Chart("title", "what it shows", "x", "y", lines, **options)


def test_a_line_is_drawn_from_left_to_right_and_upwards():
    svg = ElementTree.fromstring(chart(Line("a", [0, 1, 2], [10.0, 20.0, 30.0], "main")).svg())
    (line,) = svg.iter("polyline")
    points = [tuple(map(float, pair.split(","))) for pair in line.get("points").split()]
    assert [x for x, _ in points] == sorted(x for x, _ in points)
    assert [y for _, y in points] == sorted((y for _, y in points), reverse=True), "SVG's y axis points down"
    assert svg.get("role") == "img" and "what it shows" in svg.get("aria-label")


def test_a_missing_value_breaks_the_line_and_a_lonely_one_is_a_point():
    svg = ElementTree.fromstring(chart(Line("a", [0, 1, 2, 3, 4], [1.0, 2.0, None, 3.0, None], "main")).svg())
    assert len(list(svg.iter("polyline"))) == 1
    assert len([c for c in svg.iter("circle") if c.get("class") == "mark main"]) == 1


@pytest.mark.parametrize("values", [[], [5.0], [None], [3.0, 3.0]])
def test_any_data_gives_a_chart(values):
    ElementTree.fromstring(chart(Line("a", list(range(len(values))), values, "main")).svg())


def test_text_is_escaped():
    page = chart(Line("<b>", [0, 1], [0.0, 1.0], "main")).figure()
    assert "<b>" not in page and "&lt;b&gt;" in page


def test_ticks_are_round_and_inside():
    axis = _axis(33.2, 38.9, 5, tight=False)
    assert axis.ticks[0] == axis.low and axis.ticks[-1] == pytest.approx(axis.high)
    assert axis.low <= 33.2 and axis.high >= 38.9
    assert {round(b - a, 9) for a, b in zip(axis.ticks, axis.ticks[1:], strict=False)} == {2.0}
    assert (axis.position(axis.low), axis.position(axis.high)) == (0.0, 1.0)


def test_a_logarithmic_axis_spaces_decades_evenly():
    axis = _log_axis(1.0, 100.0)
    assert {1.0, 10.0, 100.0} <= set(axis.ticks)
    assert axis.position(10) - axis.position(1) == pytest.approx(axis.position(100) - axis.position(10))


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (1234.5, "1,234"), (0.25, "0.25"), (37.2468, "37.25"), (-3.0, "-3"), (1000000, "1,000,000")],
)
def test_numbers_have_four_digits_at_most(value, text):
    assert _number(value) == text
