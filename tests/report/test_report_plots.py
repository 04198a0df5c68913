"""Plots: well-formed SVG, places of values, escaping, empty data."""

from __future__ import annotations

import numpy as np
import pytest
from defusedxml.ElementTree import fromstring
from hypothesis import given
from hypothesis import strategies as st

from geomosaic.report.numbers import by_deviation, duration, percent, short, signed, whole
from geomosaic.report.plots import Axis, Series, histogram, line_plot
from geomosaic.report.svg import nice_ticks, tick_texts

SVG = "{http://www.w3.org/2000/svg}"


@given(st.floats(-1e5, 1e5), st.floats(1e-3, 1e6), st.integers(2, 12))
def test_ticks_enclose_the_data_at_even_steps(low, span, about):
    ticks = nice_ticks(low, low + span, about)
    assert ticks[0] <= low + 1e-6 * span and ticks[-1] >= low + span - 1e-6 * span
    assert 2 <= len(ticks) <= 2 * about + 3
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)


def test_ticks_by_hand():
    assert nice_ticks(0.0, 8.7) == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert nice_ticks(1.0, 3.0, least_step=1.0) == [1.0, 2.0, 3.0]
    assert nice_ticks(float("nan"), 1.0)[0] == 0.0
    assert nice_ticks(5.0, 5.0)[0] < 5.0 < nice_ticks(5.0, 5.0)[-1]
    assert tick_texts([0.0, 0.05, 0.1]) == ["0.00", "0.05", "0.10"]
    assert tick_texts([-20.0, 0.0, 20.0]) == ["-20", "0", "20"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0123456, "0.0123"),
        (12.345, "12.3"),
        (9.996, "10.0"),
        (0.09996, "0.100"),
        (999.7, "1\u202f000"),
        (-99.96, "-100"),
        (1234.5, "1\u202f234"),
        (float("nan"), "–"),
        (None, "–"),
        (0.0, "0"),
        (3e-6, "3.0e-06"),
    ],
)
def test_short_numbers(value, text):
    assert short(value) == text
    assert short(2.5, "m") == "2.50\u00a0m"


def test_all_other_numbers_are_written_by_the_same_rule():
    assert signed(0.01234, "m") == "+0.0123\u00a0m" and signed(-3.0) == "-3.00" and signed(0.0) == "0"
    assert signed(float("nan")) == "–" and whole(1234567) == "1\u202f234\u202f567"
    assert percent(0.12345) == "12.3\u00a0%" and percent(None) == "–" and percent(1.0) == "100\u00a0%"
    assert duration(0.0005) == "< 0.01\u00a0s" and duration(11.01) == "11.0\u00a0s"
    assert duration(131.9) == "2\u00a0min 11\u00a0s"
    assert [by_deviation(sd) for sd in (0.0042, 4.9, 250.0)] == [4, 1, 0]


def test_a_line_goes_where_its_values_say():
    plot = line_plot(
        [Series("a", [0.0, 10.0], [0.0, 4.0], marks=False)], Axis("x", "s"), Axis("y", "m"), label="l"
    )
    root = fromstring(plot)
    (line,) = root.iter(f"{SVG}polyline")
    # box: 66 to 704 across, 34 to 294 down
    assert line.get("points") == "66,294 704,34"
    words = [t.text for t in root.iter(f"{SVG}text")]
    assert "x [s]" in words and "y [m]" in words and "10" in words


def test_unknown_values_break_a_line():
    y = [1.0, 2.0, np.nan, 3.0, 4.0, np.nan]
    root = fromstring(line_plot([Series("a", np.arange(6), y)], Axis("x"), Axis("y"), label="l"))
    assert len(list(root.iter(f"{SVG}polyline"))) == 2
    assert len(list(root.iter(f"{SVG}circle"))) == 4


def test_histogram_counts_and_tells_of_what_lies_beyond():
    values = np.concatenate([np.full(50, 0.2), np.full(149, 0.9), [40.0]])
    root = fromstring(histogram(values, Axis("residual", "px"), label="l", bins=10))
    heights = sorted(float(r.get("height")) for r in root.iter(f"{SVG}rect"))
    assert len(heights) == 2 and heights[-1] == pytest.approx(3 * heights[0], rel=0.01)
    assert any("beyond" in (t.text or "") and "40" in t.text for t in root.iter(f"{SVG}text"))


def test_nothing_to_draw_is_still_an_image():
    for plot in (
        line_plot([], Axis("x"), Axis("y"), label="l"),
        histogram([], Axis("x"), label="l"),
    ):
        assert "nan" not in plot and fromstring(plot).tag == f"{SVG}svg"


def test_strangers_names_stay_text():
    bad = '"><script>alert(1)</script>&'
    plots = [
        line_plot([Series(bad, [0, 1], [0, 1])] * 2, Axis(bad), Axis("y"), label=bad),
        histogram([1.0], Axis(bad), label=bad),
    ]
    for plot in plots:
        assert "<script" not in plot
        assert fromstring(plot).find(f"{SVG}title").text == bad
