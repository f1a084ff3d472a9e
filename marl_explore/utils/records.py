"""Result folders, and what is needed to reproduce the results."""

from __future__ import annotations

import platform
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from marl_explore.utils.json_files import write_json
from marl_explore.utils.versions import versions

__all__ = ["new_folder", "provenance", "require_new", "write_json"]


def new_folder(path: str | Path) -> Path:
    """Create a folder for results.

    Raises:
        ValueError: when it exists and is not empty.
    """
    path = require_new(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def require_new(path: str | Path) -> Path:
    """Raise an error for a folder that exists and is not empty.

    Raises:
        ValueError: naming it.
    """
    if str(path) == "":
        raise ValueError("output folder '' is not allowed: name a folder")
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"output folder {str(path)!r} exists and is not empty: choose another")
    return path


def provenance() -> dict[str, Any]:
    """What is needed to repeat a run: command, versions and machine."""
    return {
        "command": _command(),
        "versions": versions(),
        "platform": platform.platform(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


def _command() -> str:
    """The command line of this program, as typed."""
    program, *words = sys.argv
    if Path(program).name in ("marl-explore", "__main__.py"):
        return shlex.join(["marl-explore", *words])
    return shlex.join([Path(sys.executable).name, program, *words])
