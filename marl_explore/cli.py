"""What the recipes' command lines share; importing it imports neither torch nor torchrl."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

import tyro

from marl_explore.config import ArenaConfig
from marl_explore.interrupts import RunInterruptedError

Arguments = TypeVar("Arguments")

OPTIONS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
"""Flags carry the names of the configuration's fields, without the path to them."""


def trained_arena(words: Sequence[str]) -> ArenaConfig:
    """The arena of the first trained policy among the words of a command line."""
    for word in words:
        if not word.startswith("-"):
            from marl_explore import evaluation

            if (arena := evaluation.trained_arena(word)) is not None:
                return arena
    return ArenaConfig()


def main(parse: Callable[[], Arguments], run: Callable[[Arguments], None]) -> None:
    """Parse and run; what goes wrong ends the program with one line and exit status 1."""
    try:
        run(parse())
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")
    except RunInterruptedError as interrupted:
        print(interrupted, file=sys.stderr)
        sys.exit(interrupted.status)
    except KeyboardInterrupt:
        sys.exit("interrupted")
