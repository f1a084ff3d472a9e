"""Tables of words and numbers, as text and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence


def number(value: float) -> str:
    """A number as a table shows it: 3 decimals below 2, else 1; "-" for NaN (nothing measured)."""
    if value != value:
        return "-"
    return f"{value:.1f}" if abs(value) >= 2 else f"{value:.3f}"


def text(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns aligned to the right under a header."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in lines
    )


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of GitHub's Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    escaped = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in escaped)
