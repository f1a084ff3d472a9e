"""What the recipes' command lines share; importing it imports neither torch nor torchrl."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from marl_explore.config import ANY_SIZE, ArenaConfig, require_integer
from marl_explore.interrupts import RunInterruptedError

if TYPE_CHECKING:
    from marl_explore.evaluation import Actor

Arguments = TypeVar("Arguments")
TaskArguments = TypeVar("TaskArguments", bound="Task")

OPTIONS = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
"""Flags carry the names of the configuration's fields, without the path to them."""


@dataclass(frozen=True)
class Task:
    """Policies that meet the same test arenas."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run folders, policy files, bundled policies or planners."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    arenas: str = "uniform"
    """A suite, whose size and density then are the arena's, or uniform."""
    steps: int | None = None
    """Most steps of an episode; default: the suite's, 300 for uniform arenas."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if self.steps is not None:
            require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)

    def find_policies(self) -> dict[str, Actor]:
        """The policies by name, ready to act on the arenas.

        Raises:
            ValueError: when there are none, or one is unknown.
        """
        from marl_explore.evaluation import find_policy

        if not self.policies:
            raise ValueError("name at least one policy, such as random or a run folder")
        return {name: find_policy(name, self.arena) for name in self.policies}


def parse_task(kind: type[TaskArguments], prog: str, description: str | None) -> TaskArguments:
    """Read a command line; a trained policy's arena is the default of the arena's flags."""
    return tyro.cli(
        kind,
        prog=prog,
        description=description,
        default=kind((), *default_task(sys.argv[1:])),
        config=OPTIONS,
    )


def named_arenas(words: Sequence[str]) -> str | None:
    """What a command line gives to --arenas, if anything."""
    for word, following in pairwise([*words, ""]):
        flag, _, value = word.partition("=")
        if flag == "--arenas":
            return value or following
    return None


def fitted(arena: ArenaConfig, arenas: str) -> ArenaConfig:
    """The robots of ``arena`` in arenas of a suite's size; others take any size."""
    if arenas in ANY_SIZE:
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


def require_package(name: str, install: str) -> None:
    """Refuse to go on without a package.

    Raises:
        ValueError: saying how to install it.
    """
    if find_spec(name) is None:
        raise ValueError(f"this recipe needs {name}: {install}")
