"""``marl-explore``: one program for everything that the package does."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Sequence
from functools import partial
from importlib import import_module

import marl_explore
from marl_explore.cli.common import run_program
from marl_explore.utils.versions import versions

COMMANDS = {
    "demo": "train for two minutes, compare with planners, draw",
    "explore": "explore maps: floor plans, ROS and MovingAI maps, drawings",
    "train": "train a team from a preset",
    "resume": "resume a run that was stopped",
    "evaluate": "compare policies on test arenas",
    "leaderboard": "compare policies on all suites: tables and a report",
    "check": "test whether policies act only on what their robots know",
    "benchmark": "run a benchmark on the field's maps, check or repeat its results",
    "maps": "check a copy of the field's maps, or draw maps like them",
    "replay": "write episodes as one page for any browser",
    "export": "export a policy for robots, as .npz and ONNX",
    "lab": "simulate robots with wheels and lidars",
    "variants": "compare training runs with a baseline, over seeds",
    "paper": "compare the paper's policies with its claims",
    "bundle": "add the policies of runs to the package",
}
"""Every subcommand, a module of this package, and what it does."""

_ABOUT = "Teams of robots that learn to explore, on TorchRL: environment, frontier features, HAPPO."


def describe() -> str:
    """The subcommands, and the public names."""
    commands = "\n".join(f"  {name:<12} {about}" for name, about in COMMANDS.items())
    names = textwrap.fill(", ".join(marl_explore.__all__), 96)
    return (
        f"commands (each with --help):\n{commands}\n\nfrom marl_explore import:\n"
        f"{textwrap.indent(names, '  ')}\n\nStart with: marl-explore demo"
    )


def version_text() -> str:
    """Versions, and the backend for frontier tables and why it is used, one per line."""
    lines = [f"{package} {version}" for package, version in versions().items()]
    return "\n".join([*lines, f"backend {marl_explore.backend()}"])


def run_command(name: str, words: Sequence[str] | None = None) -> None:
    """Run a subcommand; on an error the program prints one line and exits with status 1.

    Args:
        name: of the subcommand.
        words: its command line; None: this program's.
    """
    command = import_module(f"marl_explore.cli.{name}")
    run_program(partial(command.parse, sys.argv[1:] if words is None else words), command.run)


def main(words: Sequence[str] | None = None) -> None:
    """Run a command line; None: this program's."""
    words = sys.argv[1:] if words is None else words
    if words and words[0] in COMMANDS:
        run_command(words[0], words[1:])
        return
    parser = argparse.ArgumentParser(
        prog="marl-explore",
        usage="%(prog)s [-h] [--version] COMMAND ...",
        description=_ABOUT,
        epilog=describe(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", nargs="?", choices=COMMANDS, help=argparse.SUPPRESS)
    parser.add_argument(
        "--version", action="store_true", help="print versions and the backend in use, and why"
    )
    if parser.parse_args(words).version:
        print(version_text())
    else:
        parser.print_help()
