"""Shared by all subcommands; importing it imports neither torch nor torchrl."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.utils.interrupts import RunInterruptedError

if TYPE_CHECKING:
    from marl_explore.evaluation.episodes import Actor

Arguments = TypeVar("Arguments")
TaskArguments = TypeVar("TaskArguments", bound="Task")

OPTIONS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
"""Flags have the names of the configuration's fields, without a prefix."""


@dataclass(frozen=True)
class Task:
    """Policies on the same test arenas."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run folders, policy files, bundled policies or planners."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    arenas: str = "uniform"
    """A suite, which fixes size and density of the arenas, or uniform."""
    steps: int | None = None
    """Maximum length of an episode in steps; default: the suite's, 300 for uniform arenas."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        if self.steps is not None:
            require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)

    def find_policies(self) -> dict[str, Actor]:
        """The policies by name, ready to act in the arenas.

        Raises:
            ValueError: when no policy is given, or one is unknown.
        """
        from marl_explore.evaluation.registry import find_policy

        if not self.policies:
            raise ValueError("name at least one policy, such as random or a run folder")
        return {name: find_policy(name, self.arena) for name in self.policies}


def parse_task(
    kind: type[TaskArguments], words: Sequence[str], prog: str, about: str | None
) -> TaskArguments:
    """Parse a command line; the arena of a trained policy gives the defaults of the arena flags."""
    return tyro.cli(
        kind,
        prog=prog,
        description=about,
        args=words,
        default=kind((), *default_task(words)),
        config=OPTIONS,
    )


def flag_value(words: Sequence[str], name: str) -> str | None:
    """The value of a flag such as --arenas on a command line, if it is given."""
    for word, following in pairwise([*words, ""]):
        flag, _, value = word.partition("=")
        if flag == name:
            return value or following or None
    return None


def fitted(arena: ArenaConfig, arenas: str) -> ArenaConfig:
    """The robots of ``arena`` in arenas of the suite's size; other arenas take any size."""
    if arenas in ANY_SIZE:
        return arena
    from marl_explore.arenas import fit, is_source

    if is_source(arenas):
        _warn_of_losses(arenas, arena.cell_size)
    return fit(arena, arenas)


@lru_cache
def _warn_of_losses(arenas: str, cell_size: float) -> None:
    """Say, once, which maps a reading in cells of this size cuts up or opens."""
    from marl_explore.arenas import MapSource

    for name, (lost, opened) in MapSource.parse(arenas).losses(cell_size).items():
        print(
            f"warning: cells of {cell_size:g} m cut {lost:.0%} of the area of {name} off, and "
            f"{opened:.0%} lies behind walls that they open: marl-explore explore {name} chooses "
            "cells that fit",
            file=sys.stderr,
        )


def default_task(words: Sequence[str]) -> tuple[ArenaConfig, str]:
    """Default arena and kind of arenas of a command line, before its other flags.

    They are those of the first trained policy that it names; --arenas replaces kind and size.
    """
    arena, arenas = next(filter(None, map(_trained_on, words)), (ArenaConfig(), "uniform"))
    named = flag_value(words, "--arenas")
    return (fitted(arena, named), named) if named else (arena, arenas)


def _trained_on(word: str) -> tuple[ArenaConfig, str] | None:
    if word.startswith("-"):
        return None
    from marl_explore.evaluation import registry

    return registry.trained_on(word)


def run_program(parse: Callable[[], Arguments], run: Callable[[Arguments], None]) -> None:
    """Parse and run; on an error the program prints one line and exits with status 1."""
    try:
        run(parse())
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {error}")
    except RunInterruptedError as interrupted:
        print(interrupted, file=sys.stderr)
        sys.exit(interrupted.status)
    except KeyboardInterrupt:
        sys.exit("interrupted")


def require_package(name: str, install: str) -> None:
    """Raise an error if a package is missing.

    Raises:
        ValueError: saying how to install it.
    """
    if find_spec(name) is None:
        raise ValueError(f"this program needs {name}: {install}")
