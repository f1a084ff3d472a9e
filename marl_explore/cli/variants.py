"""Compare variants of training runs with a baseline, over training seeds: a table, and a figure.

marl-explore variants case2=runs/case2 lone-idle=runs/lone-idle gamma=runs/a,runs/b random

The first entry is the baseline. Each entry is the folder of a sweep over seeds (``marl-explore
train --seeds``), runs RUN,RUN,... that differ only in the seed, or a planner. As in the paper,
there are 200 test arenas, 300 steps, and sampled actions. Every policy keeps its own robots and
sensors, such as their range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer

STEPS = 300
DRAWN = "coverage_at_150"


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore variants``."""

    entries: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=SWEEP, NAME=RUN,RUN,... or a planner; the first entry is the baseline."""
    num_arenas: int = 200
    """Number of test arenas, the same for every policy."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path = Path("variants")
    """New folder for variants.md, variants.png and results.json."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("seed", self.seed, 0)


def parse(words: Sequence[str], prog: str = "marl-explore variants") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Evaluate all runs; write table, figure and results."""
    from marl_explore.evaluation import plots
    from marl_explore.evaluation.leaderboard import parse_entries
    from marl_explore.training import comparison
    from marl_explore.training.seeds import seed_runs
    from marl_explore.utils import records
    from marl_explore.utils.files import write_text

    settings = asdict(arguments) | {"out": str(arguments.out)}
    how = records.provenance() | {"settings": settings}
    records.require_new(arguments.out)
    entries = parse_entries(arguments.entries)
    found = comparison.find_variants({e.name: seed_runs(*e.policies) for e in entries})
    rows = comparison.compare(found, arguments.num_arenas, STEPS, arguments.seed)
    table = comparison.format_markdown(rows)
    folder = records.new_folder(arguments.out)
    write_text(folder / "variants.md", table + "\n")
    plots.seeds_figure(
        {row.variant.name: row.scores(DRAWN) for row in rows},
        folder / "variants.png",
        "coverage of the largest map at step 150 (%)",
        scale=100,
    )
    results = {row.variant.name: comparison.as_record(row) for row in rows}
    records.write_json(folder / "results.json", how | {"results": results})
    print(f"\n{table}\n\ntable, figure and all measures: {folder}")
