"""Bundle the policies of finished runs with the package, each with its curves and score.

marl-explore bundle paper-cnn-case2=runs/paper-cnn-case2-seed0 paper-mlp-case1=runs/a
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore bundle``."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=RUN for every policy."""
    out: Path | None = None
    """Folder of the files; default: the package's own."""


def run(arguments: Arguments) -> None:
    """Bundle every run, and print its score."""
    from marl_explore.evaluation.results import format_table
    from marl_explore.policies.io import BUNDLED, policy_info
    from marl_explore.training.pretrain import bundle, require_name, run_info

    named = [word.partition("=") for word in arguments.policies]
    for name, equals, folder in named:
        if not (name and equals and folder):
            raise ValueError(f"policies={name!r} is not allowed: use NAME=RUN")
        require_name(name)
    names = [name for name, _, _ in named]
    require(len(set(names)) == len(names) > 0, "policies", names, "give each name once")
    for _, _, folder in named:
        run_info(folder)  # refuses what is not a finished run before anything is written
    paths = {n: bundle(folder, n, arguments.out or BUNDLED) for n, _, folder in named}
    print(format_table({name: policy_info(path)["score"] for name, path in paths.items()}))
    for path in paths.values():
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def parse(words: Sequence[str], prog: str = "marl-explore bundle") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)
