"""Evaluate policies side by side on the same test arenas.

python recipes/evaluate.py runs/my-run nearest-timer random

python recipes/evaluate.py nearest-timer random --arenas rooms-32

The arenas are those the first trained policy was trained for, changed by the flags.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, field, replace
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
    arenas: str = "uniform"
    """A suite, whose size and density then are the arena's, or uniform."""
    num_arenas: int = 200
    """Test arenas, the same for every policy."""
    steps: int | None = None
    """Steps of every episode; default: the suite's, 300 for uniform arenas."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path | None = None
    """New folder for results.json, results.csv and table.txt; default: only print."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("num_arenas", self.num_arenas, 1)
        if self.steps is not None:
            require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)


def parse() -> Arguments:
    """Read the command line; a trained policy's arena is the default of the arena's flags."""
    return tyro.cli(
        Arguments,
        prog="evaluate.py",
        description=__doc__,
        default=Arguments((), *cli.default_task(sys.argv[1:])),
        config=cli.OPTIONS,
    )


def run(arguments: Arguments) -> None:
    """Evaluate every policy, print the table and write it."""
    from marl_explore import metrics, runs
    from marl_explore.arenas import default_steps, full_name
    from marl_explore.evaluation import find_policy, format_table, write_results
    from marl_explore.evaluation import record as record_episodes

    if not arguments.policies:
        raise ValueError("name at least one policy, such as random or a run folder")
    arguments = replace(
        arguments,
        arenas=full_name(arguments.arenas),
        steps=arguments.steps or default_steps(arguments.arenas),
    )
    record = runs.provenance() | {"settings": asdict(arguments)}
    if arguments.out:
        runs.require_new(arguments.out)
    policies = {name: find_policy(name, arguments.arena) for name in arguments.policies}
    results, scores = {}, {}
    for name, policy in policies.items():
        episodes = record_episodes(
            policy,
            arguments.arena,
            num_arenas=arguments.num_arenas,
            steps=arguments.steps,
            seed=arguments.seed,
            arenas=arguments.arenas,
        )
        results[name] = metrics.summarize(episodes)
        scores[name] = metrics.per_episode(episodes)
    print(format_table(results))
    if arguments.out:
        folder = runs.new_folder(arguments.out)
        write_results(folder, results, record, scores)
        print(f"all measures: {folder}")


if __name__ == "__main__":
    cli.main(parse, run)
