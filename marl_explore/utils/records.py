"""Result folders, and what is needed to reproduce the results."""

from __future__ import annotations

import json
import platform
import shlex
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marl_explore.utils.files import write_text
from marl_explore.utils.versions import versions


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
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"output folder {str(path)!r} exists and is not empty: choose another")
    return path


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    write_text(path, json.dumps(content, indent=2, allow_nan=True) + "\n")


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
