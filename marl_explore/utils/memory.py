"""Memory of this machine, and a check before something that would not fit is begun."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import torch
from torch import nn

CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")
_GIB = 2**30


def machine_memory() -> int | None:
    """Memory that a process may use here (bytes); None where the system does not tell.

    It is the machine's, or the limit of the control group, as in containers and batch jobs.
    """
    if not hasattr(os, "sysconf") or "SC_PHYS_PAGES" not in os.sysconf_names:
        return None
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    with suppress(OSError, ValueError):  # no control group, or no limit: "max"
        limits.append(int(CGROUP_LIMIT.read_text()))
    return min(limits)


def weights_memory(make: Callable[[], nn.Module]) -> float:
    """Size of a module's parameters (bytes), without the memory for them; infinite beyond 64 bits.

    Args:
        make: makes the module.
    """
    try:
        with torch.device("meta"):
            parameters = make().parameters()
            return float(sum(p.numel() * p.element_size() for p in parameters))
    except RuntimeError:  # torch cannot even express the size
        return math.inf


def require_memory(what: str, needed: float) -> None:
    """Raise an error for something that needs more memory than this machine has.

    Args:
        what: needs it, with the settings that decide how much.
        needed: an estimate (bytes).

    Raises:
        ValueError: naming both.
    """
    total = machine_memory()
    if total is not None and needed > total:
        raise ValueError(
            f"{what} would need about {needed / _GIB:,.3g} GiB of memory, and this machine has "
            f"{total / _GIB:.3g} GiB"
        )
