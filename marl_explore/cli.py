"""What the recipes' command lines share; importing it imports neither torch nor torchrl."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TypeVar

import tyro

from marl_explore.config import ArenaConfig
from marl_explore.interrupts import RunInterruptedError

Arguments = TypeVar("Arguments")

OPTIONS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
"""Flags carry the names of the configuration's fields, without the path to them."""


def named_arenas(words: Sequence[str]) -> str | None:
    """What a command line gives to --arenas, if anything."""
    for word, following in pairwise([*words, ""]):
        flag, _, value = word.partition("=")
        if flag == "--arenas":
            return value or following
    return None


def fitted(arena: ArenaConfig, arenas: str) -> ArenaConfig:
    """The robots of ``arena`` in arenas of a suite's size; "uniform" takes any size."""
    if arenas == "uniform":
        return arena
    from marl_explore.arenas import suite

    return suite(arenas).fit(arena)


def default_task(words: Sequence[str]) -> tuple[ArenaConfig, str]:
    """Arena and kind of arenas that a command line starts from, before its other flags.

    Those of the first trained policy among its words; --arenas replaces kind and size.
    """
    arena, arenas = next(filter(None, map(_trained_on, words)), (ArenaConfig(), "uniform"))
    named = named_arenas(words)
    return (fitted(arena, named), named) if named else (arena, arenas)


def _trained_on(word: str) -> tuple[ArenaConfig, str] | None:
    if word.startswith("-"):
        return None
    from marl_explore import evaluation

    return evaluation.trained_on(word)


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
