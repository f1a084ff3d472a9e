"""Compare policies on suites of test arenas: one table, and one HTML report with figures.

python recipes/leaderboard.py nearest-timer random --suites paper-12 rooms-32

python recipes/leaderboard.py learned=runs/seed-0,runs/seed-1 nearest-timer --out boards/mine

Every policy on every suite is one file in OUT/cells: an interrupted run goes on where it was, and
a later one only measures what is new or was measured by other code.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from marl_explore import cli
from marl_explore.config import require_integer

if TYPE_CHECKING:
    from marl_explore.arenas import Suite
    from marl_explore.leaderboard import Cell


ARENAS = ((12, 200), (24, 50))
"""Test arenas up to a size of side x side cells; beyond, planning takes long: 20."""


@dataclass(frozen=True)
class Arguments:
    """Which policies, on which suites."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Planners, run folders, policy files or bundled policies; NAME=POLICY,POLICY,... makes one
    row of several training seeds; bound is the fewest steps that could be; default: all
    planners and bound."""
    suites: tuple[str, ...] = ()
    """Suites of arenas; default: all."""
    num_arenas: int | None = None
    """Test arenas per suite; default: 200, above 12 x 12 cells 50, above 24 x 24 cells 20."""
    steps: int | None = None
    """Steps of every episode; default: the suite's."""
    seed: int = 0
    """Seed of the arenas and of sampled actions."""
    out: Path = Path("leaderboard")
    """Folder of the results."""
    threads: int = 1
    """CPU threads of torch."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        for name in ("num_arenas", "steps"):
            if getattr(self, name) is not None:
                require_integer(name, getattr(self, name), 1)
        require_integer("seed", self.seed, 0)
        require_integer("threads", self.threads, 1)


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="leaderboard.py", description=__doc__)


def run(arguments: Arguments) -> None:
    """Measure what is missing, rank, write tables and report."""
    import torch

    from marl_explore import leaderboard, runs
    from marl_explore.arenas.suites import SUITES, suite
    from marl_explore.planners import PLANNERS

    torch.set_num_threads(arguments.threads)
    record = runs.provenance() | {"settings": asdict(arguments)}
    if not (arguments.out / "cells").is_dir():
        runs.require_new(arguments.out)
    entries = leaderboard.parse_entries(arguments.policies or (*PLANNERS, leaderboard.BOUND))
    suites = [suite(name) for name in arguments.suites] or SUITES

    def cell(policy: str, place: Suite) -> Cell:
        num_arenas = next((n for side, n in ARENAS if place.config.num_cells <= side**2), 20)
        return leaderboard.Cell(
            policy,
            place,
            num_arenas=arguments.num_arenas or num_arenas,
            steps=arguments.steps or place.steps,
            seed=arguments.seed,
        )

    def cells(place: Suite) -> dict[str, list[Cell]]:
        return {e.name: [cell(policy, place) for policy in e.policies] for e in entries}

    wanted = {place.id: cells(place) for place in suites}
    all_cells = [c for rows in wanted.values() for row in rows.values() for c in row]
    results = leaderboard.make_cells(arguments.out / "cells", all_cells)
    boards = [
        leaderboard.rank({name: [results[c] for c in row] for name, row in rows.items()})
        for rows in wanted.values()
    ]
    leaderboard.write_tables(arguments.out, boards, record)
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    about = f"{record['command']} ({versions})"
    leaderboard.write_report(arguments.out / "report.html", boards, about)
    print((arguments.out / "table.txt").read_text(), end="")
    for name in ("table.md", "table.csv", "table.json", "report.html"):
        print(arguments.out / name)


if __name__ == "__main__":
    cli.main(parse, run)
