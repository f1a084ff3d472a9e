"""What the recipes' command lines share; imports neither torch nor torchrl."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro

Arguments = TypeVar("Arguments")

OPTIONS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
"""Flags carry the names of the configuration's fields, without the path to them."""


def main(parse: Callable[[], Arguments], run: Callable[[Arguments], None]) -> None:
    """Parse and run; wrong input ends the program with one line and exit status 1."""
    try:
        run(parse())
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted")
