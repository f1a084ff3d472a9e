"""Checks of single settings: each error names the setting, its value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import TypeGuard

MAX_SHOWN = 200
"""Characters of a value that an error shows."""


def require(condition: bool, name: str, value: object, allowed: str) -> None:
    """Raise an error unless a condition holds; it says what is allowed."""
    if not condition:
        shown = repr(value)
        shown = shown if len(shown) <= MAX_SHOWN else f"{shown[: MAX_SHOWN - 3]}..."
        raise ValueError(f"{name}={shown} is not allowed: {allowed}")


MAX_THREADS = 1024
MAX_INTEGER = 2**63 - 1
"""Largest integer of any setting: that of an int64."""


def is_integer(value: object) -> TypeGuard[int]:
    """Whether a value is an integer; True and False are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a real number, also one of numpy; True and False are none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def require_integer(name: str, value: object, low: int, high: int = MAX_INTEGER) -> None:
    """Require an integer from ``low`` to ``high``."""
    allowed = f"an integer of at least {low}"
    if is_integer(value) and value > high:
        allowed += f", and at most {high}"
    fits = is_integer(value) and low <= value <= high
    require(fits, name, value, f"it must be {allowed}")


def require_positive(name: str, value: object, unit: str = "", most: float = math.inf) -> None:
    """Require a positive finite number of at most ``most``."""
    of = f" of {unit}" if unit else ""
    fits = is_number(value) and 0 < value < math.inf
    require(fits, name, value, f"it must be a positive finite number{of}")
    _require_at_most(name, value, most, unit)


def require_not_negative(name: str, value: object, unit: str = "", most: float = math.inf) -> None:
    """Require a finite number of at least 0 and at most ``most``."""
    least = f"0 {unit}".strip()
    fits = is_number(value) and 0 <= value < math.inf
    require(fits, name, value, f"it must be at least {least}, and finite")
    _require_at_most(name, value, most, unit)


def require_finite(name: str, value: object, unit: str = "", most: float = math.inf) -> None:
    """Require a finite number that is at most ``most`` on either side of 0."""
    of = f" of {unit}" if unit else ""
    fits = is_number(value) and abs(value) < math.inf
    require(fits, name, value, f"it must be a finite number{of}")
    _require_at_most(name, value, most, f"{unit} on either side of 0".strip())


def _require_at_most(name: str, value: object, most: float, unit: str) -> None:
    fits = is_number(value) and abs(value) <= most
    require(fits, name, value, f"it must be at most {most:g} {unit}".strip())


MOST_SECONDS = 1e10
"""Times that are farther from 0 are not of this century."""


def require_time(name: str, value: object) -> None:
    """Require a time of a clock (seconds)."""
    fits = is_number(value) and abs(value) <= MOST_SECONDS
    allowed = f"it must be at most {MOST_SECONDS:g} seconds on either side of 0"
    require(fits, name, value, allowed)


def require_share(name: str, value: object) -> None:
    """Require a number in [0, 1]."""
    require(is_number(value) and 0 <= value <= 1, name, value, "it must lie in [0, 1]")


def require_coverage(name: str, value: float | None) -> None:
    """Require None or a coverage in (0, 1]."""
    number = isinstance(value, (int, float)) and 0 < value <= 1
    require(value is None or number, name, value, "it must be None or lie in (0, 1]")


def require_threads(threads: object) -> None:
    """Require a number of CPU threads that torch can start."""
    require_integer("threads", threads, 1, MAX_THREADS)


def require_widths(name: str, widths: Sequence[int]) -> None:
    """Require at least one width, all of them positive integers."""
    require(len(widths) > 0, name, widths, "it needs at least one width")
    for width in widths:
        require_integer(name, width, 1)
