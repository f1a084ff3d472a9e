"""Evaluate policies side by side on the same test arenas.

python recipes/evaluate.py runs/my-run nearest-timer random

python recipes/evaluate.py nearest-timer random --arenas rooms-32

python recipes/evaluate.py paper-cnn-case2 paper-cnn-case2:argmax

Policies draw their actions; with :argmax they take the likeliest, a random allowed move after a
refusal, and draw when their map has not grown for more than 12 steps. The arenas are those the
first trained policy was trained for, changed by the flags.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

from marl_explore import cli
from marl_explore.config import require_integer


@dataclass(frozen=True)
class Arguments(cli.Task):
    """Which policies, on which arenas."""

    num_arenas: int = 200
    """Test arenas, the same for every policy."""
    out: Path | None = None
    """New folder for results.json, results.csv and table.txt; default: only print."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        super().__post_init__()
        require_integer("num_arenas", self.num_arenas, 1)


def parse() -> Arguments:
    """Read the command line."""
    return cli.parse_task(Arguments, "evaluate.py", __doc__)


def run(arguments: Arguments) -> None:
    """Evaluate every policy, print the table and write it."""
    from marl_explore import metrics, runs
    from marl_explore.arenas import default_steps, full_name
    from marl_explore.evaluation import format_table, write_results
    from marl_explore.evaluation import record as record_episodes

    arguments = replace(
        arguments,
        arenas=full_name(arguments.arenas),
        steps=arguments.steps or default_steps(arguments.arenas),
    )
    record = runs.provenance() | {"settings": asdict(arguments)}
    if arguments.out:
        runs.require_new(arguments.out)
    policies = arguments.find_policies()
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
