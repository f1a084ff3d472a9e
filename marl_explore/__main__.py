"""``python -m marl_explore``: what there is; with --version what it runs on."""

from __future__ import annotations

import argparse
import textwrap

import marl_explore
from marl_explore.versions import versions

_ABOUT = "Teams of robots that learn to explore, on TorchRL: environment, frontier features, HAPPO."
_MORE = """
further modules, imported by their names:
  marl_explore.arenas        suites and generators of arenas, map files
  marl_explore.planners      classical exploration behind the interface of a policy
  marl_explore.evaluation    policies on test arenas, episodes to look at
  marl_explore.stats         intervals and comparisons over seeds and arenas
  marl_explore.plots         figures and animations
  marl_explore.replay        episodes as one HTML page
  marl_explore.adapters      the task in other frameworks
  marl_explore.export        policies for robots without torch
  marl_explore.robot         what runs on a robot: numpy alone
  marl_explore.lab           the simulated lab

The source tree has docs/api.md, with an example for each, and programs to train, evaluate
and compare in recipes/, each with --help: start with "make demo" or "python recipes/train.py fast".
"""


def describe() -> str:
    """Usage, the public names, and where to read on."""
    names = textwrap.fill(", ".join(marl_explore.__all__), 96)
    return f"from marl_explore import:\n{textwrap.indent(names, '  ')}\n{_MORE}"


def version_text() -> str:
    """Versions, and what computes frontier tables and why, a line each."""
    lines = [f"{package} {version}" for package, version in versions().items()]
    return "\n".join([*lines, f"backend {marl_explore.backend()}"])


def main() -> None:
    """Answer a command line."""
    parser = argparse.ArgumentParser(
        prog="python -m marl_explore",
        description=_ABOUT,
        epilog=describe(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--version", action="store_true", help="print versions and the backend in use, and why"
    )
    if parser.parse_args().version:
        print(version_text())
    else:
        parser.print_help()


if __name__ == "__main__":
    main()
