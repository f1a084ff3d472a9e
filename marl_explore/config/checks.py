"""Checks of single settings: each error names the setting, its value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence


def require(condition: bool, name: str, value: object, allowed: str) -> None:
    """Raise an error unless a condition holds; it says what is allowed."""
    if not condition:
        raise ValueError(f"{name}={value!r} is not allowed: {allowed}")


def require_integer(name: str, value: object, low: int) -> None:
    """Require an integer of at least ``low``."""
    integer = isinstance(value, int) and not isinstance(value, bool)
    require(
        integer and value >= low,  # type: ignore[operator]
        name,
        value,
        f"it must be an integer of at least {low}",
    )


def require_positive(name: str, value: float, unit: str) -> None:
    """Require a positive finite number."""
    require(0 < value < math.inf, name, value, f"it must be a positive finite number of {unit}")


def require_not_negative(name: str, value: float, unit: str) -> None:
    """Require a finite number of at least 0."""
    require(0 <= value < math.inf, name, value, f"it must be at least 0 {unit}, and finite")


def require_coverage(name: str, value: float | None) -> None:
    """Require None or a coverage in (0, 1]."""
    require(value is None or 0 < value <= 1, name, value, "it must be None or lie in (0, 1]")


def require_widths(name: str, widths: Sequence[int]) -> None:
    """Require at least one width, all of them positive integers."""
    require(len(widths) > 0, name, widths, "it needs at least one width")
    for width in widths:
        require_integer(name, width, 1)
