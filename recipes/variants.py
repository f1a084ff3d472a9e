"""Hold variants of a training against a baseline, over training seeds: a table, and a figure.

python recipes/variants.py case2=runs/case2 literal=runs/literal gamma=runs/a,runs/b random

The first entry is the baseline. Each is the folder of a sweep over seeds (train.py --seeds), runs
RUN,RUN,... of one training, or a planner. As in the paper: 200 test arenas, 300 steps, sampled
actions; every policy keeps its own robots and sensors, such as their range.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore import cli
from marl_explore.config import require_integer

STEPS = 300
DRAWN = "coverage_at_150"


@dataclass(frozen=True)
class Arguments:
    """Which trainings, and where the results go."""

    entries: Annotated[tuple[str, ...], tyro.conf.Positional]
    """NAME=SWEEP, NAME=RUN,RUN,... or a planner; the first one is the baseline."""
    num_arenas: int = 200
    """Test arenas, the same for every policy."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path = Path("variants")
    """New folder for variants.md, variants.png and results.json."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("num_arenas", self.num_arenas, 1)
        require_integer("seed", self.seed, 0)


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="variants.py", description=__doc__)


def run(arguments: Arguments) -> None:
    """Evaluate all runs; write table, figure and numbers."""
    from marl_explore import plots, runs, variants
    from marl_explore.files import write_text
    from marl_explore.leaderboard import parse_entries
    from marl_explore.sweeps import seed_runs

    settings = asdict(arguments) | {"out": str(arguments.out)}
    how = runs.provenance() | {"settings": settings}
    runs.require_new(arguments.out)
    entries = parse_entries(arguments.entries)
    found = variants.find_variants({e.name: seed_runs(*e.policies) for e in entries})
    rows = variants.compare(found, arguments.num_arenas, STEPS, arguments.seed)
    table = variants.format_markdown(rows)
    folder = runs.new_folder(arguments.out)
    write_text(folder / "variants.md", table + "\n")
    plots.seeds_figure(
        {row.variant.name: row.scores(DRAWN) for row in rows},
        folder / "variants.png",
        "coverage of the largest map at step 150 (%)",
        scale=100,
    )
    results = {row.variant.name: variants.as_record(row) for row in rows}
    runs.write_json(folder / "results.json", how | {"results": results})
    print(f"\n{table}\n\ntable, figure and all measures: {folder}")


if __name__ == "__main__":
    cli.main(parse, run)
