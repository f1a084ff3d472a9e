"""Shared by all subcommands; importing it imports neither torch nor torchrl."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro

from marl_explore.cli.config_file import take_config
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
    """Run folders, policy files, bundled policies, planners, or package.module:attribute."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    arenas: str = "uniform"
    """A suite, which fixes size and density of the arenas, or everything; or uniform, uniform-v2 or
    mixed, which take any size."""
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


def parse_options(
    kind: type[Arguments], words: Sequence[str], prog: str, about: str | None
) -> Arguments:
    """Parse a command line of options and ``--config FILE``.

    Raises:
        ValueError: for a setting that is not allowed.
        SystemExit: for anything else that is wrong, and after --help.
    """
    words, file = take_config(words)
    return parse_words(kind, words, prog, about, file.new(kind) if file else None)


def parse_task(
    kind: type[TaskArguments], words: Sequence[str], prog: str, about: str | None
) -> TaskArguments:
    """As ``parse_options``; the arena of a trained policy gives the defaults of the arena flags."""
    words, file = take_config(words)
    named, arenas = list(words), None
    if file is not None:
        named += map(str, file.get("policies") or ())
        arenas = file.get("arenas")
    default = kind((), *default_task(named, arenas))
    return parse_words(kind, words, prog, about, file.fill(default) if file else default)


def parse_action(
    actions: Mapping[str, type[Arguments]], words: Sequence[str], prog: str, about: str | None
) -> Arguments:
    """As ``parse_options``, for a command whose first word says which options follow."""
    if not words or words[0] not in actions:
        parser = argparse.ArgumentParser(
            prog=prog, description=about, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        parser.add_argument("action", choices=actions, help="each with --help")
        parser.parse_args(words[:1])  # says what is wrong, or helps, and exits
    return parse_options(actions[words[0]], words[1:], f"{prog} {words[0]}", about)


def parse_words(
    kind: type[Arguments],
    words: Sequence[str],
    prog: str,
    about: str | None,
    default: Arguments | None = None,
) -> Arguments:
    """Parse a command line of options; as ``parse_options``."""
    for word in words:
        if not word or (word.startswith("--") and word.endswith("=")):
            raise ValueError(f"{word!r} is not allowed on a command line: give a value")
    hint = "\n\nOptions may also stand in a YAML or JSON file: --config FILE"
    told = io.StringIO()
    try:
        with redirect_stderr(told):  # tyro's message is replaced when the fault is in a setting
            return tyro.cli(
                kind,
                prog=prog,
                description=(about or "") + hint,
                args=words,
                config=OPTIONS,
                default=tyro.MISSING_NONPROP if default is None else default,
            )
    except SystemExit as stop:
        if (error := _refusal(stop)) is not None:
            raise ValueError(error) from None
        sys.stderr.write(told.getvalue())
        raise


def _refusal(stop: SystemExit) -> str | None:
    """What a settings class said of a value that it refused, if that is why tyro exits."""
    error: BaseException | None = stop
    while error is not None:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        module = trace.tb_frame.f_globals["__name__"] if trace is not None else "tyro"
        if isinstance(error, ValueError) and module.partition(".")[0] != "tyro":
            return str(error)
        error = error.__context__
    return None


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
        warn_of_losses(arenas, arena.cell_size)
    return fit(arena, arenas)


@lru_cache
def warn_of_losses(arenas: str, cell_size: float) -> None:
    """Say, once, which maps a reading in cells of this size cuts up or opens."""
    from marl_explore.arenas import MapSource

    for name, (lost, opened) in MapSource.parse(arenas).losses(cell_size).items():
        print(
            f"warning: cells of {cell_size:g} m cut {lost:.0%} of the area of {name} off, and "
            f"{opened:.0%} lies behind walls that they open: marl-explore explore {name} chooses "
            "cells that fit",
            file=sys.stderr,
        )


def default_task(
    words: Sequence[str], arenas_of_file: str | None = None
) -> tuple[ArenaConfig, str]:
    """Default arena and kind of arenas of a command line, before its other flags.

    They are those of the first trained policy that it names; --arenas, or what a file of options
    says, replaces kind and size.
    """
    arena, arenas = next(filter(None, map(_trained_on, words)), (ArenaConfig(), "uniform"))
    named = flag_value(words, "--arenas") or arenas_of_file
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
    except (ValueError, OSError, FloatingPointError, ImportError, MemoryError) as error:
        sys.exit(f"error: {str(error) or type(error).__name__}")
    except RuntimeError as error:
        if "allocate memory" not in str(error):  # torch has no error of its own for it
            raise
        sys.exit(f"error: out of memory: {str(error).strip().splitlines()[-1]}")
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
