"""Whether a computation runs in C or in torch."""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import get_args

import torch

from marl_explore.core import native
from marl_explore.core.native import BACKENDS, Backend, Kernel

MISSING: dict[Kernel, str | None] = {name: native.missing(name) for name in get_args(Kernel)}
"""Why each kernel cannot be used, or None; found once, as torch.compile cannot look for files."""


def in_use(kernel: Kernel, backend: Backend, device: torch.device) -> bool:
    """Whether a backend is the native one for tensors on a device.

    Raises:
        ValueError: for an unknown backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend={backend!r} is not one of {BACKENDS}")
    if backend == "auto" and device.type == "cpu":
        if MISSING[kernel] is None:
            return True
        if not torch.compiler.is_compiling():
            _say_slow()
        return False
    return backend == "native"


@lru_cache
def _say_slow() -> None:
    """Warn once that computations on the CPU have no kernel."""
    warnings.warn(
        f"{native.backend()}; everything works, several times slower. A wheel has the kernels, and "
        "so does an installation with a C compiler",
        RuntimeWarning,
        stacklevel=2,
    )
