"""Tables as plain text and as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence


def number(value: float) -> str:
    """A number formatted for a table: 3 decimals below 2, else 1; "-" for NaN (not measured)."""
    if value != value:
        return "-"
    return f"{value:.{_decimals(value)}f}"


def estimate(value: float, low: float, high: float, sign: str = "") -> str:
    """A number with its interval in brackets, without one if bounds are NaN; "-" for NaN.

    Args:
        value: shown with as many decimals as ``number`` gives the largest of the three.
        low: lower bound.
        high: upper bound.
        sign: "+" shows the sign of positive numbers too.
    """
    if value != value:
        return "-"
    if low != low:
        return f"{value:{sign}.{_decimals(value)}f}"
    form = f"{sign}.{_decimals(value, low, high)}f"
    return f"{value:{form}} [{low:{form}}, {high:{form}}]"


def text(header: Sequence[str], *blocks: Sequence[Sequence[str]]) -> str:
    """Right-aligned columns, with a line under the header and between blocks of rows."""
    rows = [row for block in blocks for row in block]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    rule = ["-" * width for width in widths]
    lines = [header]
    for block in blocks:
        lines += [rule, *block]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )


def markdown(header: Sequence[str], *blocks: Sequence[Sequence[str]]) -> str:
    """A table in GitHub's Markdown, with an empty row between blocks of rows.

    Whatever a cell holds, such as a policy's name, is shown as it is.
    """
    lines = [list(map(_as_it_is, header)), ["---"] * len(header)]
    for i, block in enumerate(blocks):
        lines += [[""] * len(header)] * (i > 0) + [list(map(_as_it_is, line)) for line in block]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _as_it_is(cell: str) -> str:
    """Text without meaning in Markdown: no markup, HTML, link or new line."""
    escaped = re.sub(r"[\\`*|<>~&]|(?<!\w)_|_(?!\w)|\](?=[(\[:])", r"\\\g<0>", cell)
    return " ".join(escaped.split())


def _decimals(*values: float) -> int:
    return 1 if max(map(abs, values)) >= 2 else 3
