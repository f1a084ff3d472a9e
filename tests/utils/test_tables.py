"""Tables: how numbers are shown and columns aligned."""

from __future__ import annotations

import math

import pytest

from marl_explore.utils import tables


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0.12345, "0.123"), (1.0, "1.000"), (-1.5, "-1.500"), (2.04, "2.0"), (-38.66, "-38.7")],
)
def test_small_numbers_show_three_decimals_large_ones_one(value, shown):
    assert tables.number(value) == shown


def test_nothing_measured_shows_a_dash():
    assert tables.number(float("nan")) == "-"


@pytest.mark.parametrize(
    ("values", "sign", "shown"),
    [
        ((0.5, 0.25, 1.0), "", "0.500 [0.250, 1.000]"),
        ((0.5, -3.0, 4.0), "+", "+0.5 [-3.0, +4.0]"),  # all with the decimals of the largest
        ((0.5, math.nan, math.nan), "", "0.500"),
        ((-30.0, math.nan, math.nan), "+", "-30.0"),
        ((math.nan, math.nan, math.nan), "+", "-"),
    ],
)
def test_intervals_stand_in_brackets(values, sign, shown):
    assert tables.estimate(*values, sign=sign) == shown


def test_text_is_aligned_to_the_right():
    assert tables.text(["name", "x"], [["a", "1.000"], ["longer", "2.0"]]).splitlines() == [
        "  name      x",
        "------  -----",
        "     a  1.000",
        "longer    2.0",
    ]


def test_blocks_of_rows_stand_apart():
    assert tables.text(["x"], [["1"]], [["22"]]).splitlines() == [" x", "--", " 1", "--", "22"]
    lines = tables.markdown(["x"], [["1"]], [["22"]]).splitlines()
    assert lines == ["| x |", "| --- |", "| 1 |", "|  |", "| 22 |"]


def test_markdown_escapes_what_separates_its_columns():
    assert tables.markdown(["name", "x"], [["a|b", "1"]]).splitlines() == [
        "| name | x |",
        "| --- | --- |",
        r"| a\|b | 1 |",
    ]
