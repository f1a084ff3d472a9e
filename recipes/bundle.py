"""Make finished runs policies that come with the package, each with its curves and its score.

python recipes/bundle.py paper-cnn-case2=runs/paper-cnn-case2-seed0 paper-mlp-case1=runs/a
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore import cli


@dataclass(frozen=True)
class Arguments:
    """Which runs, under which names."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=RUN, for every policy."""
    out: Path | None = None
    """Folder of the files; default: the package's own."""


def run(arguments: Arguments) -> None:
    """Bundle every run, and print its score."""
    from marl_explore.bundled import bundle
    from marl_explore.evaluation import format_table
    from marl_explore.policies import BUNDLED, policy_info

    named = [word.partition("=") for word in arguments.policies]
    for name, equals, folder in named:
        if not (name and equals and folder):
            raise ValueError(f"policies={name!r} is not allowed: use NAME=RUN")
    paths = {n: bundle(folder, n, arguments.out or BUNDLED) for n, _, folder in named}
    print(format_table({name: policy_info(path)["score"] for name, path in paths.items()}))
    for path in paths.values():
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="bundle.py", description=__doc__)


if __name__ == "__main__":
    cli.main(parse, run)
