"""Training curves: CSV files of rows "frames,value", one file per metric."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from marl_explore.utils.files import write_text


def read_curve(path: Path) -> NDArray[np.float64]:
    """Frames and values [R, 2] of a curve, without the unfinished last row of a killed run.

    Raises:
        ValueError: naming file and line, for a row that is not one of a curve.
    """
    rows = [[frames, value] for _, frames, value in _rows(path)]
    return np.array(rows, np.float64).reshape(-1, 2)


def rewind(path: Path, frames: int) -> None:
    """Drop the rows of a curve after a number of frames, and an unfinished row.

    Raises:
        ValueError: as for ``read_curve``.
    """
    kept = "".join(row for row, number, _ in _rows(path) if number <= frames)
    if len(kept) < path.stat().st_size:
        write_text(path, kept)


def _rows(path: Path) -> Iterator[tuple[str, int, float]]:
    """Every whole row as it stands, with its frames and its value."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line, row in enumerate(file, 1):
            if not row.endswith("\n"):
                return
            try:
                frames, value = row.split(",")
                number = int(frames)
                float(number)  # beyond its range no curve goes
                yield row, number, float(value)
            except (ValueError, OverflowError) as error:
                raise ValueError(
                    f"{path}, line {line} is not a row of a curve, frames and value: "
                    f"{row.strip()[:80]!r}"
                ) from error
