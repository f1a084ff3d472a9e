"""The C kernels for computations on the CPU, if the package was installed with a compiler.

Each C file is built as an optional extension when the package is installed, and loaded here with
ctypes, without torch. ``native.operator`` (frontier tables), ``native.goals`` (candidate goals),
``native.paths`` (shortest paths), ``native.sight`` (line of sight) and ``native.sensing`` pass
tensors to them, ``robot.frontier`` and ``robot.goals`` arrays. Without them everything still works.
``marl_explore.backend()`` says which backend is in use and why.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any, Literal, get_args

from marl_explore.config.constants import Normalization

_NO_MEMORY, _OUTSIDE, _SEEN_OUTSIDE, _NO_SUCH = 1, 2, 3, 4  # error codes of the C functions
MODES: dict[Normalization | None, int] = {None: 0, "relative": 1, "proximity": 2, "absolute": 3}
"""The kernel's numbers for the normalisations."""

Kernel = Literal[
    "frontier",
    "goals",
    "paths",
    "floods",
    "beam values",
    "beam plans",
    "sight",
    "discoveries",
    "surroundings",
    "sense",
    "merge",
    "step",
]
"""Tables of paths to frontiers (FPR), candidate goals, paths to cells, cells that paths reach, line
of sight, expected discoveries, what is around robots, what they write into their maps, merging
them, a whole step."""
Backend = Literal["auto", "torch", "native"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)
"""What computes: torch, a kernel (CPU tensors only), or a kernel where that is possible."""


def _layout(arrays: str, sizes: str, floats: str = "") -> tuple[tuple[str, Any], ...]:
    """The fields of a structure, names with spaces between: addresses, then int64, then floats."""
    kinds = ((arrays, ctypes.c_void_p), (sizes, ctypes.c_int64), (floats, ctypes.c_float))
    return tuple((name, kind) for names, kind in kinds for name in names.split())


class GoalBatch(ctypes.Structure):
    """Addresses of the arrays of candidate goals, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "maps positions taken allowed seen_steps seen_cells known_by covered headings "
        "goals radii gains frontiers rivals ways all_covered",
        "team height width kinds",
    )


class BeamTurn(ctypes.Structure):
    """Addresses of the arrays of a robot's turn in joint plans, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "cell before unknown code seen occupied target share distance visible near "
        "inside window on_grid place hashes value new_seen new_code first best "
        "best_value to_cell to_before to_first to_unknown to_code to_seen",
        "plans robots cells targets side2 robot kept is_first",
        floats="weight of_distance favour of_order",
    )


class PathQueries(ctypes.Structure):
    """Addresses of the arrays of shortest paths, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "maps cells which starts moves lengths",
        "num_maps height width num_cells",
    )


class Floods(ctypes.Structure):
    """Addresses of the arrays of cells that paths reach, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout("starts open passable reached", "height width")


class SightQueries(ctypes.Structure):
    """Addresses of the arrays of expected discoveries, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "maps which cell kind masks found",
        "num_maps height width num_kinds side hides",
    )


class Looks(ctypes.Structure):
    """Addresses of the arrays of what is around robots, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "walls own people masks view",
        "team num_people cells width num_kinds side hides",
    )


class Readings(ctypes.Structure):
    """Addresses of the arrays of what robots write into maps, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "view position alive target maps discovered targets",
        "team height width side",
    )


class Teams(ctypes.Structure):
    """Addresses of the arrays of teams that merge their maps, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "linked communicating target maps network received targets",
        "team cells",
    )


class Step(ctypes.Structure):
    """Addresses of the arrays of a step of the world, all contiguous, and their sizes.

    The C file says how large each array is.
    """

    _fields_ = _layout(
        "walls masks target action start allowed unshared waited known missing maps position "
        "dangerous view linked network pending new_unshared new_waited new_allowed discovered "
        "received new_known new_missing own targets more_targets communicating",
        "team height width num_kinds side hides reach never",
    )


_POINTER, _INTEGER = ctypes.c_void_p, ctypes.c_int64
# of each kernel its file, its function and the arguments of that
_FUNCTIONS: dict[Kernel, tuple[str, str, tuple[Any, ...]]] = {
    "frontier": (
        "frontier",
        "marl_explore_frontier_tables",
        (_POINTER, _POINTER, *[_INTEGER] * 3, *[ctypes.c_int] * 2, _POINTER),
    ),
    "goals": (
        "goals",
        "marl_explore_goal_tables",
        (ctypes.POINTER(GoalBatch), _INTEGER, _INTEGER),
    ),
    "beam values": (
        "beam",
        "marl_explore_beam_values",
        (ctypes.POINTER(BeamTurn), _INTEGER, _INTEGER),
    ),
    "beam plans": (
        "beam",
        "marl_explore_beam_plans",
        (ctypes.POINTER(BeamTurn), _INTEGER, _INTEGER),
    ),
    "paths": (
        "paths",
        "marl_explore_paths",
        (ctypes.POINTER(PathQueries), _INTEGER, _INTEGER),
    ),
    "floods": ("paths", "marl_explore_floods", (ctypes.POINTER(Floods), _INTEGER, _INTEGER)),
    "sight": (
        "world",
        "marl_explore_line_of_sight",
        (_POINTER, _INTEGER, _INTEGER, _POINTER),
    ),
    "discoveries": (
        "world",
        "marl_explore_expected_discoveries",
        (ctypes.POINTER(SightQueries), _INTEGER, _INTEGER),
    ),
    "surroundings": (
        "world",
        "marl_explore_surroundings",
        (ctypes.POINTER(Looks), _INTEGER, _INTEGER),
    ),
    "sense": ("world", "marl_explore_sense", (ctypes.POINTER(Readings), _INTEGER, _INTEGER)),
    "merge": ("world", "marl_explore_merge", (ctypes.POINTER(Teams), _INTEGER, _INTEGER)),
    "step": ("world", "marl_explore_step", (ctypes.POINTER(Step), _INTEGER, _INTEGER)),
}


@lru_cache
def _load(name: Kernel) -> Callable[..., int] | OSError:
    """The function of a kernel, or why there is none."""
    library, function, arguments = _FUNCTIONS[name]
    files = [Path(__file__).parent / f"_{library}{suffix}" for suffix in EXTENSION_SUFFIXES]
    built = [file for file in files if file.is_file()]
    if not built:
        return OSError(f"it was not built: {_why_not_built()}")
    try:
        loaded = ctypes.CDLL(str(built[0]))[function]
    except (OSError, AttributeError) as error:  # also an older library without the function
        return OSError(*error.args)
    loaded.argtypes = arguments
    loaded.restype = ctypes.c_int
    return loaded


def _why_not_built() -> str:
    source = Path(__file__).parents[3]
    if (source / "pyproject.toml").is_file():
        return (
            f"this is the source in {source}, which Python takes before an installed package when "
            "it runs there; install it with a C compiler by pip install -e ., or work elsewhere"
        )
    return "the package was installed without a C compiler"


def missing(name: Kernel = "frontier") -> str | None:
    """Why a native kernel cannot be used; None if it can."""
    found = _load(name)
    return str(found) if isinstance(found, OSError) else None


def backend() -> str:
    """The backend for CPU tensors, and why it is used, in one line."""
    reason = next(filter(None, map(missing, _FUNCTIONS)), None)
    return f"torch: the native kernel is missing, {reason}" if reason else "native: C kernel"


def kernel(name: Kernel = "frontier") -> Callable[..., int]:
    """A C function; those with a structure take it and the first and last of its rows.

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
    if failed == _NO_SUCH:
        raise ValueError("there is no such map, action or kind of robot")
