"""Tables of words and numbers, as text and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def number(value: float) -> str:
    """A number as a table shows it: 3 decimals below 2, else 1; "-" for NaN (nothing measured)."""
    if value != value:
        return "-"
    return f"{value:.1f}" if abs(value) >= 2 else f"{value:.3f}"


def text(header: Sequence[str], *blocks: Sequence[Sequence[str]]) -> str:
    """Columns aligned to the right; a line under the header and between blocks of rows."""
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
    """A table of GitHub's Markdown, with an empty row between blocks of rows."""
    lines = [header, ["---"] * len(header)]
    for i, block in enumerate(blocks):
        lines += [[""] * len(header)] * (i > 0) + list(block)
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in escaped)
