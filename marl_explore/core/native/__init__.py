"""The C kernels for tables on the CPU, if the package was installed with a compiler.

Each C file is built as an optional extension when the package is installed, and loaded here with
ctypes, without torch. ``native.operator`` (frontier tables) and ``native.goals`` (candidate goals)
pass tensors to them, ``robot.frontier`` and ``robot.goals`` arrays. Without them everything still
works. ``marl_explore.backend()`` says which backend is in use and why.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any, Literal

from marl_explore.config.constants import Normalization

_NO_MEMORY, _OUTSIDE, _SEEN_OUTSIDE = 1, 2, 3  # error codes of the C functions
MODES: dict[Normalization | None, int] = {None: 0, "relative": 1, "proximity": 2, "absolute": 3}
"""The kernel's numbers for the normalisations."""

Kernel = Literal["frontier", "goals"]
"""Tables of paths to frontiers (FPR), and candidate goals."""


class GoalBatch(ctypes.Structure):
    """Addresses of the arrays of candidate goals, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = (
        *(
            (name, ctypes.c_void_p)
            for name in (
                "maps",
                "positions",
                "taken",
                "allowed",
                "seen_steps",
                "seen_cells",
                "known_by",
                "covered",
                "headings",
                "goals",
                "frontiers",
                "rivals",
                "ways",
                "all_covered",
            )
        ),
        *((name, ctypes.c_int64) for name in ("team", "height", "width", "radius")),
    )


_POINTER, _INTEGER = ctypes.c_void_p, ctypes.c_int64
_FUNCTIONS: dict[Kernel, tuple[str, tuple[Any, ...]]] = {
    "frontier": (
        "marl_explore_frontier_tables",
        (_POINTER, _POINTER, *[_INTEGER] * 3, *[ctypes.c_int] * 2, _POINTER),
    ),
    "goals": ("marl_explore_goal_tables", (ctypes.POINTER(GoalBatch), _INTEGER, _INTEGER)),
}


@lru_cache
def _load(name: Kernel) -> Callable[..., int] | OSError:
    """The function of a kernel, or why there is none."""
    files = [Path(__file__).parent / f"_{name}{suffix}" for suffix in EXTENSION_SUFFIXES]
    built = [file for file in files if file.is_file()]
    if not built:
        return OSError("it was not built: the package was installed without a C compiler")
    function, arguments = _FUNCTIONS[name]
    try:
        loaded = ctypes.CDLL(str(built[0]))[function]
    except OSError as error:
        return error
    loaded.argtypes = arguments
    loaded.restype = ctypes.c_int
    return loaded


def missing(name: Kernel = "frontier") -> str | None:
    """Why a native kernel cannot be used; None if it can."""
    found = _load(name)
    return str(found) if isinstance(found, OSError) else None


def backend() -> str:
    """The backend for tables of CPU tensors, and why it is used, in one line."""
    reason = missing() or missing("goals")
    return f"torch: the native kernel is missing, {reason}" if reason else "native: C kernel"


def kernel(name: Kernel = "frontier") -> Callable[..., int]:
    """A C function; that of ``goals`` takes a ``GoalBatch`` and the first and last of its robots.

    Raises:
        RuntimeError: when it cannot be used.
    """
    found = _load(name)
    if isinstance(found, OSError):
        raise RuntimeError(f"the native kernel cannot be used: {found}")
    return found


def check(failed: int, height: int, width: int) -> None:
    """Raise an error for an error code of a C function."""
    if failed == _NO_MEMORY:
        raise MemoryError(f"not enough memory for tables of maps of {height} x {width} cells")
    if failed == _OUTSIDE:
        raise ValueError(f"a position is outside its map of {height} x {width} cells")
    if failed == _SEEN_OUTSIDE:
        raise ValueError(f"a teammate was seen outside the map of {height} x {width} cells")
