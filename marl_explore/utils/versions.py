"""Versions of the packages that results depend on; this imports neither torch nor torchrl."""

from __future__ import annotations

import platform
from importlib.metadata import version

PACKAGES = ("marl-explore", "torch", "torchrl", "tensordict")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {p: version(p) for p in PACKAGES}
