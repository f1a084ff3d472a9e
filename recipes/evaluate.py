"""Evaluate policies side by side on the same test arenas.

python recipes/evaluate.py runs/my-run nearest-timer random

The arenas are those the first trained policy was trained for, changed by the flags.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore import cli
from marl_explore.config import ArenaConfig, require_integer


@dataclass(frozen=True)
class Arguments:
    """Which policies, on which arenas."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Run folders, policy files, bundled policies or planners."""
    arena: ArenaConfig = field(default_factory=ArenaConfig)
    num_arenas: int = 200
    """Test arenas, the same for every policy."""
    steps: int = 300
    """Steps of every episode."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path | None = None
    """New folder for results.json, results.csv and table.txt; default: only print."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)


def parse() -> Arguments:
    """Read the command line; a trained policy's arena is the default of the arena's flags."""
    return tyro.cli(
        Arguments,
        prog="evaluate.py",
        description=__doc__,
        default=Arguments((), cli.trained_arena(sys.argv[1:])),
        config=cli.OPTIONS,
    )


def run(arguments: Arguments) -> None:
    """Evaluate every policy, print the table and write it."""
    from marl_explore import runs
    from marl_explore.evaluation import evaluate, find_policy, format_table, write_results

    if not arguments.policies:
        raise ValueError("name at least one policy, such as random or a run folder")
    record = runs.provenance() | {"settings": asdict(arguments)}
    if arguments.out:
        runs.require_new(arguments.out)
    policies = {name: find_policy(name, arguments.arena) for name in arguments.policies}
    results = {}
    for name, policy in policies.items():
        results[name] = evaluate(
            policy,
            arguments.arena,
            num_arenas=arguments.num_arenas,
            steps=arguments.steps,
            seed=arguments.seed,
        )
    print(format_table(results))
    if arguments.out:
        folder = runs.new_folder(arguments.out)
        write_results(folder, results, record)
        print(f"all measures: {folder}")


if __name__ == "__main__":
    cli.main(parse, run)
