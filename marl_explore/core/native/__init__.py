"""The C kernel for frontier tables on the CPU, if the package was installed with a compiler.

The C file is built as an optional extension when the package is installed, and loaded here with
ctypes, without torch. ``native.operator`` passes tensors to it, ``robot.frontier`` arrays. Without
it everything still works. ``marl_explore.backend()`` says which backend is in use and why.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from marl_explore.config.constants import Normalization

_NO_MEMORY, _OUTSIDE = 1, 2  # error codes of the C function
MODES: dict[Normalization | None, int] = {None: 0, "relative": 1, "proximity": 2, "absolute": 3}
"""The kernel's numbers for the normalisations."""


@lru_cache
def _library() -> ctypes.CDLL | OSError:
    """The shared library, or why there is none."""
    files = [Path(__file__).parent / f"_frontier{suffix}" for suffix in EXTENSION_SUFFIXES]
    built = [file for file in files if file.is_file()]
    if not built:
        return OSError("it was not built: the package was installed without a C compiler")
    try:
        library = ctypes.CDLL(str(built[0]))
    except OSError as error:
        return error
    function = library.marl_explore_frontier_tables
    pointer, integer = ctypes.c_void_p, ctypes.c_int64
    number = ctypes.c_int
    function.argtypes = [pointer, pointer, integer, integer, integer, number, number, pointer]
    function.restype = ctypes.c_int
    return library


def missing() -> str | None:
    """Why the native kernel cannot be used; None if it can."""
    library = _library()
    return str(library) if isinstance(library, OSError) else None


def backend() -> str:
    """The backend for frontier tables of CPU tensors, and why it is used, in one line."""
    reason = missing()
    return f"torch: the native kernel is missing, {reason}" if reason else "native: C kernel"


def kernel() -> Callable[..., int]:
    """The C function.

    Raises:
        RuntimeError: when it cannot be used.
    """
    library = _library()
    if isinstance(library, OSError):
        raise RuntimeError(f"the native kernel cannot be used: {library}")
    return library.marl_explore_frontier_tables


def check(failed: int, height: int, width: int) -> None:
    """Raise an error for an error code of the C function."""
    if failed == _NO_MEMORY:
        raise MemoryError(f"not enough memory for frontier tables of {height} x {width} cells")
    if failed == _OUTSIDE:
        raise ValueError(f"a position is outside its map of {height} x {width} cells")
