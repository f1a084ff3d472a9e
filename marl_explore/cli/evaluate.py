"""Evaluate policies side by side on the same test arenas.

marl-explore evaluate runs/my-run nearest-timer random

marl-explore evaluate nearest-timer random --arenas rooms-32

marl-explore evaluate paper-cnn-case2 paper-cnn-case2:argmax

marl-explore evaluate mypackage.agents:Explorer nearest-timer

Policies sample their actions. With :argmax they take the most likely action, make a random allowed
move after a refused one, and sample when their map has not grown for more than 12 steps; those that
choose among goals keep their goal when it has not grown for more than 40. The arenas
are those that the first trained policy was trained for, unless flags change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from marl_explore.cli.common import Task, parse_task
from marl_explore.config.checks import require_integer


@dataclass(frozen=True)
class Arguments(Task):
    """Options of ``marl-explore evaluate``."""

    num_arenas: int | None = None
    """Test arenas, the same for every policy; default: 200, or every map of a folder once."""
    device: str = "cpu"
    """Where to compute: cpu, cuda, cuda:1, ... (CUDA is not tested)."""
    out: Path | None = None
    """New folder for results.json, results.csv and table.txt; default: print only."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        super().__post_init__()
        if self.num_arenas is not None:
            require_integer("num_arenas", self.num_arenas, 1)


def parse(words: Sequence[str], prog: str = "marl-explore evaluate") -> Arguments:
    """Parse a command line."""
    return parse_task(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Evaluate every policy, print the table and write it."""
    from marl_explore.arenas import default_number, default_steps, full_name
    from marl_explore.evaluation import metrics
    from marl_explore.evaluation.episodes import record as record_episodes
    from marl_explore.evaluation.results import format_table, write_results
    from marl_explore.utils import records

    num_arenas = arguments.num_arenas or default_number(arguments.arenas)
    arguments = replace(
        arguments,
        arenas=full_name(arguments.arenas),
        steps=arguments.steps or default_steps(arguments.arenas),
        num_arenas=num_arenas,
    )
    record = records.provenance() | {"settings": asdict(arguments)}
    if arguments.out:
        records.require_new(arguments.out)
    policies = arguments.find_policies()
    results, scores = {}, {}
    for name, policy in policies.items():
        episodes = record_episodes(
            policy,
            arguments.arena,
            num_arenas=num_arenas,
            steps=arguments.steps,
            seed=arguments.seed,
            arenas=arguments.arenas,
            device=arguments.device,
        )
        results[name] = metrics.summarize(episodes)
        scores[name] = metrics.per_episode(episodes)
    print(format_table(results))
    if arguments.out:
        folder = records.new_folder(arguments.out)
        write_results(folder, results, record, scores)
        print(f"all measures: {folder}")
